"""Public data sets by name: what their files hold, and the team file for them."""
