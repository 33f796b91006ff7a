"""Runs in tiles: the space is cut into columns, each of which is replayed by itself, and their results are joined."""
