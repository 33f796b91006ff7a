"""Compiled loops of the mapping package, one file for each task."""
