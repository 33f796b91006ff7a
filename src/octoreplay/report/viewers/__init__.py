"""Results in other programs: layouts for Foxglove and RViz, recordings for Rerun."""
