"""A room with boxes whose distances and labels follow from its planes: what an ideal sensor in it measures."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

FLOOR, WALL, CRATE, SHELF = 1, 2, 7, 12
NAMES = {FLOOR: "floor", WALL: "wall", CRATE: "crate", SHELF: "shelf"}
"""Raw labels and their names."""

# No plane lies on a face of the maps' cells, where rounding would say on which side a point is.
INSIDE = np.array([[-4.03, -3.02, -0.043], [4.04, 3.01, 2.53]])
BOXES = np.array(
    [
        [[1.21, -1.52, -0.043], [2.13, -0.74, 0.93]],
        [[2.62, 0.58, -0.043], [3.14, 1.87, 1.71]],
        [[-2.83, 0.36, -0.043], [-1.74, 1.43, 0.62]],
        [[-1.13, -2.91, -0.043], [0.34, -2.24, 1.97]],
    ]
)
BOX_LABELS = np.array([CRATE, SHELF, CRATE, SHELF])


def cast(origin: npt.NDArray[np.float64], directions: npt.NDArray[np.float64]) -> tuple[np.ndarray, np.ndarray]:
    """Distance along each ray in units of its direction, (...) float64, and raw label of the hit surface, (...) uint8.

    ``origin`` (3,) lies in the room, outside the boxes; ``directions`` are (..., 3).
    """
    with np.errstate(divide="ignore"):
        to_planes = (INSIDE[:, None] - origin) / directions[..., None, None, :]
    leaves = to_planes.max(axis=-3)[..., 0, :]
    nearest = leaves.min(axis=-1)
    is_floor = (leaves[..., 2] == nearest) & (directions[..., 2] < 0)
    labels = np.where(is_floor, FLOOR, WALL)
    for box, label in zip(BOXES, BOX_LABELS, strict=True):
        with np.errstate(divide="ignore"):
            to_sides = (box - origin) / directions[..., None, :]
        enters, leaves = to_sides.min(axis=-2).max(axis=-1), to_sides.max(axis=-2).min(axis=-1)
        is_hit = (enters > 0) & (enters <= leaves) & (enters < nearest)
        nearest, labels = np.where(is_hit, enters, nearest), np.where(is_hit, label, labels)
    return nearest, labels.astype(np.uint8)


def look(T_room_sensor: npt.NDArray[np.float64], directions: npt.NDArray[np.float64]) -> tuple[np.ndarray, np.ndarray]:
    """As ``cast``, for directions (..., 3) in the frame of a sensor with a pose (4, 4)."""
    return cast(T_room_sensor[:3, 3], directions @ T_room_sensor[:3, :3].T)
