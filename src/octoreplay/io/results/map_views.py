"""Maps for viewers: occupied leaves as points of a PointCloud2."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from octoreplay.log_odds import best_labels, label_probabilities
from octoreplay.records import ClassTable, LeafTable

_FLOAT32, _UINT8 = 7, 2
"""sensor_msgs/PointField datatypes."""
VIEW_FIELDS = (
    ("x", "<f4", 0, _FLOAT32),
    ("y", "<f4", 4, _FLOAT32),
    ("z", "<f4", 8, _FLOAT32),
    ("rgb", "<u4", 12, _FLOAT32),
    ("label", "u1", 24, _UINT8),
    ("size", "<f4", 16, _FLOAT32),
    ("probability", "<f4", 20, _FLOAT32),
)
"""Fields of a point in a map view: name, NumPy format, offset, PointField datatype. ``rgb`` holds the integer
0x00RRGGBB and is declared as float32, a convention of PCL that viewers follow."""
VIEW_DTYPE = np.dtype(
    {
        "names": [name for name, *_ in VIEW_FIELDS],
        "formats": [number_format for _, number_format, *_ in VIEW_FIELDS],
        "offsets": [offset for *_, offset, _ in VIEW_FIELDS],
        "itemsize": 28,
    }
)


def view_points(leaves: LeafTable, classes: ClassTable) -> npt.NDArray[Any]:
    """Return the occupied leaves of a map as an array of ``VIEW_DTYPE``, with the colours of the classes."""
    label = best_labels(leaves.log_odds)
    occupied = np.flatnonzero(label)
    label = label[occupied]
    points = np.zeros(len(occupied), dtype=VIEW_DTYPE)
    for axis, name in enumerate("xyz"):
        points[name] = leaves.centers[occupied, axis]
    color = classes.colors.astype(np.uint32)[label.astype(np.intp) - 1]
    points["rgb"] = (color[:, 0] << 16) | (color[:, 1] << 8) | color[:, 2]
    points["label"] = label
    points["size"] = leaves.sizes[occupied]
    points["probability"] = label_probabilities(leaves.log_odds[occupied])
    return points
