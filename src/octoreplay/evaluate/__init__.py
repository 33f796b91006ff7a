"""Quality of a stored result: against the truth, the centralised map, limits or another result."""
