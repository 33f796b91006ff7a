"""octoreplay: replays multi-robot logs into semantic octree maps that the team agrees on."""

__version__ = "0.1.0"
