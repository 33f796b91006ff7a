"""Encoder of maps as NumPy archives."""

from __future__ import annotations

import io

import numpy as np

from octoreplay.log_odds import best_labels, class_probabilities
from octoreplay.records import ClassTable, LeafTable, UInt8Array


def archive_file(leaves: LeafTable, colors: UInt8Array, classes: ClassTable, resolution: float) -> bytes:
    """Return the leaves of a map as a compressed archive.

    Its arrays are ``centers`` (L, 3) float64 [m], ``sizes`` (L,) float64 [m], ``log_odds`` (L, C) float32,
    ``probabilities`` (L, C + 1) float32, free first, ``labels`` (L,) uint8, 0 for free, ``colors`` (L, 3) uint8,
    ``class_names`` (C + 1,) text, and ``resolution`` float64 [m].
    """
    archive = io.BytesIO()
    np.savez_compressed(
        archive,
        centers=leaves.centers,
        sizes=leaves.sizes,
        log_odds=leaves.log_odds,
        probabilities=class_probabilities(leaves.log_odds).astype(np.float32),
        labels=best_labels(leaves.log_odds),
        colors=colors,
        class_names=np.array(("free", *classes.names)),
        resolution=np.float64(resolution),
    )
    return archive.getvalue()
