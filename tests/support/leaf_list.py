"""A map as a plain list of leaves, in place of the octree and its codec: judges what is built upon them."""

from __future__ import annotations

import io

import numpy as np
import pytest

from octoreplay.records import BoolArray, Float32Array, Float64Array, LeafTable


class LeafList:
    """Leaves that are looked up one by one; log-odds are deviations from the prior."""

    def __init__(self, resolution: float, leaves: LeafTable) -> None:
        self.resolution = resolution
        self.num_classes = leaves.log_odds.shape[1]
        self.table = leaves

    memory_bytes = 0

    def leaves(self, prior: float = 0.0, most_bytes: int | None = None) -> LeafTable:
        return LeafTable(self.table.centers, self.table.sizes, self.table.log_odds + np.float32(prior))

    def lookup(self, coords: Float64Array) -> tuple[Float32Array, BoolArray, Float64Array]:
        log_odds = np.zeros((len(coords), self.num_classes), dtype=np.float32)
        known, sizes = np.zeros(len(coords), dtype=np.bool_), np.zeros(len(coords))
        for row, coord in enumerate(coords):
            low = self.table.centers - self.table.sizes[:, None] / 2
            inside = np.flatnonzero(((low <= coord) & (coord < low + self.table.sizes[:, None])).all(axis=1))
            if len(inside):
                log_odds[row], known[row] = self.table.log_odds[inside[0]], True
                sizes[row] = self.table.sizes[inside[0]]
        return log_odds, known, sizes


def encode(leaves: LeafTable, resolution: float = 0.2) -> bytes:
    """Bytes of a leaf list, as key frame or as delta."""
    stream = io.BytesIO()
    np.savez(stream, centers=leaves.centers, sizes=leaves.sizes, log_odds=leaves.log_odds, resolution=resolution)
    return stream.getvalue()


def decode(data: bytes, most_bytes: int | None = None, box: None = None) -> LeafList:
    """A leaf list from its bytes."""
    content = np.load(io.BytesIO(data))
    leaves = LeafTable(content["centers"], content["sizes"], content["log_odds"])
    return LeafList(float(content["resolution"]), leaves)


def apply(octree: LeafList, data: bytes, most_bytes: int | None = None, box: None = None) -> None:
    """Append the delta's leaves."""
    more, old = decode(data).table, octree.table
    octree.table = LeafTable(
        np.concatenate([old.centers, more.centers]),
        np.concatenate([old.sizes, more.sizes]),
        np.concatenate([old.log_odds, more.log_odds]),
    )


def scaled(octree: LeafList, factor: float) -> LeafList:
    """The leaves with their log-odds multiplied."""
    table = octree.table
    return LeafList(octree.resolution, LeafTable(table.centers, table.sizes, table.log_odds * np.float32(factor)))


def install(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let stored maps be leaf lists."""
    monkeypatch.setattr("octoreplay.result.decode_packet", decode)
    monkeypatch.setattr("octoreplay.result.apply_delta", apply)
    monkeypatch.setattr("octoreplay.stored_map.scaled_map", scaled)
