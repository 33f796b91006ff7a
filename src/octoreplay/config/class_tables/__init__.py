"""Tables of classes: those of well-known data sets (the CSV files here; SOURCES.md says where they are from), files of
other mapping tools, and what a team makes of a table by merging and ignoring.
"""
