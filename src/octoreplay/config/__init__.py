"""Configuration: everything that a user can set, from files, presets and options."""
