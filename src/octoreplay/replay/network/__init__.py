"""The simulated communication network: graph, topology, schedule and links."""
