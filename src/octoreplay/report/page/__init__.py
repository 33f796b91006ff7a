"""Web page of a result: a 3-D view of the maps over time, charts and tables in one HTML file."""
