"""Sweeps over settings, and the experiments of docs/experiments.md."""
