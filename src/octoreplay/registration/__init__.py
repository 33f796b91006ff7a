"""Frames of a team: own maps, search, verification and refinement of pairs, and the frames of a team."""
