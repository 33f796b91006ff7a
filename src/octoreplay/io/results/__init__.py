"""The result of a run as MCAP, and maps as PLY."""
