"""Class tables of well-known data sets and of other mapping tools, and edits of class tables.

The CSV files are the built-in tables; SOURCES.md lists their sources.
"""
