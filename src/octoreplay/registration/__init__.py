"""Frames of a team: own maps, search, verification and refinement of pairs, frames of a team, and repair of drift."""
