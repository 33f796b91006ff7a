"""Encoder of LAS and LAZ point clouds (ASPRS LAS 1.4), written by the optional package laspy."""

from __future__ import annotations

import datetime
import io
from typing import Any

import numpy as np

from octoreplay.errors import ConfigError
from octoreplay.log_odds import best_labels, label_probabilities
from octoreplay.records import ClassTable, Int64Array, LeafTable, UInt8Array

_POINT_FORMAT = 7
"""Point data record format with colours and a classification of eight bits."""
_SCALE = 1e-4
"""Unit of the stored coordinates [m]."""


def points_file(
    leaves: LeafTable, colors: UInt8Array, classes: ClassTable, robots: Int64Array, day: datetime.date, *,
    compressed: bool,
) -> bytes:  # fmt: skip
    """Return a LAS file, or a LAZ file with ``compressed``, of the centres of the leaves.

    The classification is the class_id, 0 for free; a classification lookup record holds the names. Extra dimensions are
    ``probability`` of the label (float32), ``size``, the edge of the leaf [m] (float32), and ``robot``, the index in
    the team of the robot of the map (uint16). Coordinates are multiples of 0.1 mm.

    ``colors`` is (L, 3) uint8, ``robots`` (L,) are the indices, ``day`` is the creation date of the header. Raises
    ConfigError where laspy or its encoder lazrs is missing.
    """
    laspy = _laspy()
    header = laspy.LasHeader(version="1.4", point_format=_POINT_FORMAT)
    header.creation_date, header.generating_software, header.system_identifier = day, "octoreplay", "octree map"
    header.scales, header.offsets = np.full(3, _SCALE), np.floor(leaves.centers.min(axis=0))
    extra = [("probability", np.float32, "of the label"), ("size", np.float32, "edge of the leaf [m]"),
             ("robot", np.uint16, "index in the team")]  # fmt: skip
    header.add_extra_dims([laspy.ExtraBytesParams(name, kind, text) for name, kind, text in extra])
    header.vlrs.append(_names(laspy, classes))
    points = laspy.LasData(header)
    points.x, points.y, points.z = leaves.centers.T
    for channel, name in enumerate(("red", "green", "blue")):
        # LAS colours have 16 bits; 257 maps 255 to 65535.
        points[name] = colors[:, channel].astype(np.uint16) * 257
    points["classification"] = best_labels(leaves.log_odds)
    points["probability"] = label_probabilities(leaves.log_odds)
    points["size"] = leaves.sizes.astype(np.float32)
    points["robot"] = robots.astype(np.uint16)
    file = io.BytesIO()
    # One thread, so that equal maps give equal bytes.
    points.write(file, do_compress=compressed, laz_backend=laspy.LazBackend.Lazrs if compressed else None)
    return file.getvalue()


def _names(laspy: Any, classes: ClassTable) -> Any:
    """Classification lookup record: names of the classes, cut to the 15 ASCII characters of the format."""
    record = laspy.vlrs.known.ClassificationLookupVlr()
    for class_id, name in enumerate(("free", *classes.names)):
        record[class_id] = name.encode("ascii", "replace").decode()[:15]
    return record


def _laspy() -> Any:
    """Return the module laspy. Raises ConfigError where it or lazrs is missing."""
    try:
        import laspy
        import lazrs  # noqa: F401 - laspy uses it for LAZ
    except ImportError as error:
        raise ConfigError(
            f"LAS and LAZ files need the package {error.name}; install it with: pip install 'octoreplay[las]'"
        ) from error
    return laspy
