"""Folders of other people's data, written as logs."""
