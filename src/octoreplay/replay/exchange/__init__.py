"""The exchange of maps: messages, packets, and the versions that robots hold."""
