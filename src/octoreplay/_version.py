"""The version of octoreplay."""

__version__ = "0.1.0"
