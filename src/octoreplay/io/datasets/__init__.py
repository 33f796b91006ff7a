"""Import of public datasets' folders as logs."""
