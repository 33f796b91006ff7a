"""Robots in logs: their topics, their poses, and their frames in stamp order."""
