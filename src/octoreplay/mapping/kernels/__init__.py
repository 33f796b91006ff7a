"""The compiled loops of the map, one file for each thing they do."""
