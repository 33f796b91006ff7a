"""Results of runs as MCAP files, and maps as PLY files."""
