"""Default colours of classes."""

from __future__ import annotations

PALETTE: tuple[tuple[int, int, int], ...] = (
    (230, 159, 0), (86, 180, 233), (0, 158, 115), (240, 228, 66), (0, 114, 178), (213, 94, 0), (204, 121, 167),
    (120, 120, 120), (127, 60, 141), (17, 165, 121), (57, 105, 172), (242, 183, 1), (231, 63, 116), (128, 186, 90),
)  # fmt: skip
"""Colours of classes that define none; the first seven are Okabe and Ito's colour-blind safe set."""
