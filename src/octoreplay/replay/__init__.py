"""Time and team: the shared clock, robots, communication graph and the session that runs them."""
