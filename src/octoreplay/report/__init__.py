"""What people look at: tables, plots and exports of a result."""
