"""How good a stored result is: against the truth, against the centralised map, against another result."""
