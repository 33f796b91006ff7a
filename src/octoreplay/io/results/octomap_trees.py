"""Encoder of OctoMap's tree files: ``.bt`` (OcTree, occupied or free) and ``.ot`` (ColorOcTree, log-odds and colours).

The formats are those of OctoMap 1.9 (``AbstractOccupancyOcTree::writeBinary``, ``AbstractOcTree::write``): a header of
text lines, then the nodes in depth-first order. Child i of a node has bit 0 of i set for the upper half in x, bit 1 in
y, bit 2 in z.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from octoreplay.log_odds import occupancy_log_odds
from octoreplay.records import BoolArray, Float32Array, Float64Array, Int64Array, LeafTable, UInt8Array

DEPTH = 16
"""Depth of the finest cells of an OctoMap tree."""

_NODE = np.dtype([("log_odds", "<f4"), ("color", "u1", 3), ("children", "u1")])
"""Node of a ColorOcTree with the bits of its children."""
_FREE, _OCCUPIED, _INNER = 1, 2, 3
"""Two bits for each child in a ``.bt`` file, the first one in the lower bit; 0: unknown."""


def tree_file(leaves: LeafTable, colors: UInt8Array, resolution: float, *, binary: bool) -> bytes:
    """Return a map as ``.bt`` file (``binary``) or ``.ot`` file.

    A leaf is occupied where the probability of all occupied classes together is at least 0.5, as OctoMap defines it.
    Inner nodes have the largest log-odds and the mean colour of their children. ``colors`` is (L, 3) uint8,
    ``resolution`` the edge of the finest cells [m]. Raises ValueError where the map exceeds OctoMap's key space of 2^16
    cells along each axis.
    """
    levels = _levels(leaves, colors, resolution)
    name, kind = ("OcTree", "OcTree binary file") if binary else ("ColorOcTree", "OcTree file")
    num_nodes = sum(level.codes.size for level in levels)
    header = (
        f"# Octomap {kind}\n# (feel free to add / change comments, but leave the first line as it is!)\n#\n"
        f"id {name}\nsize {num_nodes}\nres {resolution!r}\ndata\n"
    )
    return header.encode() + (_binary_nodes(levels) if binary else _nodes(levels))


def binary_tree(leaves: LeafTable, resolution: float) -> bytes:
    """Return the nodes of a ``.bt`` file without its header, as ``octomap_msgs/Octomap`` holds them.

    Raises ValueError as ``tree_file``.
    """
    return _binary_nodes(_levels(leaves, np.zeros((len(leaves), 3), np.uint8), resolution))


class _Level:
    """Nodes of one depth in Morton order.

    ``codes`` (n,) are the Morton codes at this depth, ``log_odds`` (n,) the occupancy, ``colors`` (n, 3) float64 the
    mean colours, ``is_inner`` (n,) is True for nodes with children, and ``states`` (n, 8) the two bits of each child.
    """

    def __init__(self, codes: Int64Array, log_odds: Float32Array, colors: Float64Array) -> None:
        self.codes = codes
        self.log_odds = log_odds
        self.colors = colors
        self.states = np.zeros((codes.size, 8), np.uint8)

    @property
    def is_inner(self) -> BoolArray:
        """True for nodes with children."""
        return np.asarray(self.states.any(axis=1))

    def parents(self) -> _Level:
        """Return the parents of all nodes."""
        codes, rows = np.unique(self.codes >> 3, return_inverse=True)
        log_odds = np.full(codes.size, -np.inf, np.float32)
        np.maximum.at(log_odds, rows, self.log_odds)
        counts = np.bincount(rows, minlength=codes.size)
        colors = np.column_stack([np.bincount(rows, self.colors[:, axis], codes.size) for axis in range(3)])
        parents = _Level(codes, log_odds, colors / counts[:, None])
        leaf_states = np.where(self.log_odds >= 0.0, _OCCUPIED, _FREE)
        parents.states[rows, (self.codes & 7).astype(np.intp)] = np.where(self.is_inner, _INNER, leaf_states)
        return parents

    def joined(self, other: _Level) -> _Level:
        """Return the nodes of both, which are different ones."""
        order = np.argsort(np.concatenate([self.codes, other.codes]), kind="stable")
        joined = _Level(
            np.concatenate([self.codes, other.codes])[order],
            np.concatenate([self.log_odds, other.log_odds])[order],
            np.concatenate([self.colors, other.colors])[order],
        )
        joined.states = np.concatenate([self.states, other.states])[order]
        return joined


def _levels(leaves: LeafTable, colors: UInt8Array, resolution: float) -> list[_Level]:
    """Return all nodes by depth, the root first."""
    edges = np.rint(leaves.sizes / resolution).astype(np.int64)
    keys = np.rint(leaves.centers / resolution - edges[:, None] / 2).astype(np.int64)
    half = 1 << (DEPTH - 1)
    if len(leaves) and (keys.min() < -half or (keys + edges[:, None]).max() > half):
        raise ValueError(
            f"the map reaches further than {half * resolution:g} m from the origin, which OctoMap's keys of 16 bits"
            " cannot hold"
        )
    codes = _morton_codes(keys + half)
    heights = np.rint(np.log2(edges)).astype(np.int64)
    log_odds = occupancy_log_odds(leaves.log_odds)
    level = _Level(np.empty(0, np.int64), np.empty(0, np.float32), np.empty((0, 3)))
    levels = []
    for height in range(DEPTH + 1):
        chosen = heights == height
        own = _Level(codes[chosen] >> 3 * height, log_odds[chosen], colors[chosen].astype(np.float64))
        level = level.joined(own)
        levels.append(level)
        level = level.parents()
    return levels[::-1]


def _morton_codes(keys: Int64Array) -> Int64Array:
    """Return the Morton codes (n,) of keys (n, 3) in [0, 2^DEPTH), x in the lowest bit."""
    codes = np.zeros(len(keys), np.int64)
    for bit in range(DEPTH):
        for axis in range(3):
            codes |= (keys[:, axis] >> bit & 1) << (3 * bit + axis)
    return codes


def _order(levels: list[_Level], chosen: list[BoolArray]) -> npt.NDArray[np.intp]:
    """Return the depth-first order of the chosen nodes of all levels, which are given one level after the other."""
    codes = [level.codes[keep] for level, keep in zip(levels, chosen, strict=True)]
    first_cells = [codes_of << 3 * (DEPTH - depth) for depth, codes_of in enumerate(codes)]
    depths = [np.full(codes_of.size, depth) for depth, codes_of in enumerate(codes)]
    return np.lexsort((np.concatenate(depths), np.concatenate(first_cells)))


def _nodes(levels: list[_Level]) -> bytes:
    """Return the nodes of a ColorOcTree."""
    everything = [np.ones(level.codes.size, np.bool_) for level in levels]
    nodes = np.zeros(sum(level.codes.size for level in levels), _NODE)
    nodes["log_odds"] = np.concatenate([level.log_odds for level in levels])
    nodes["color"] = np.rint(np.concatenate([level.colors for level in levels]))
    bits = np.concatenate([(level.states > 0).astype(np.uint8) for level in levels])
    nodes["children"] = np.packbits(bits, axis=1, bitorder="little")[:, 0]
    return nodes[_order(levels, everything)].tobytes()


def _binary_nodes(levels: list[_Level]) -> bytes:
    """Return the inner nodes of an OcTree, two bytes each."""
    inner = [level.is_inner for level in levels]
    states = np.concatenate([level.states[keep] for level, keep in zip(levels, inner, strict=True)])
    bits = np.bitwise_or.reduce(states.astype(np.uint16) << (2 * np.arange(8, dtype=np.uint16)), axis=1)
    return bytes(bits.astype("<u2")[_order(levels, inner)].tobytes())
