"""Paths of recordings made by others, which lie beside the project; tests skip where they are absent."""

from pathlib import Path

import pytest

RECORDINGS = Path(__file__).resolve().parents[2].parent / "shared" / "data"

needs_recordings = pytest.mark.skipif(
    not RECORDINGS.is_dir(), reason="the recordings made by others are not beside the project"
)
