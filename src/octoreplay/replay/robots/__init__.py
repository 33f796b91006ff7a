"""Robots of a team: one module for each family of rules."""
