"""Map of one robot at one stored tick: leaves, and queries at points and in boxes."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from octoreplay.config.sensor import region_of
from octoreplay.data_table import Table
from octoreplay.errors import ConfigError, InputError
from octoreplay.log_odds import best_labels, class_probabilities, label_probabilities
from octoreplay.mapping.consensus import scaled_map
from octoreplay.mapping.key_box import KeyBox
from octoreplay.mapping.octree import KEY_BITS, SemanticOctree
from octoreplay.mapping.regions import coarsened, cut
from octoreplay.records import (
    CENTRAL,
    MAP_KINDS,
    MEAN,
    POSTERIOR,
    TEAM,
    BoolArray,
    Float32Array,
    Float64Array,
    LeafTable,
    UInt8Array,
    public_names,
)


@dataclass(frozen=True, eq=False)
class PointQuery:
    """State of a map at P points.

    Attributes
    ----------
    log_odds : (P, C) float32
        log p(c) / p(free), including the prior.
    probabilities : (P, C + 1) float32
        Probabilities, free first.
    labels : (P,) uint8
        Most probable class_id, 0 for free.
    known : (P,) bool
        False in unknown space, where the other fields are those of the prior.
    sizes : (P,) float64
        Edge of the leaf around the point in metres, 0 in unknown space.
    """

    log_odds: Float32Array
    probabilities: Float32Array
    labels: UInt8Array
    known: BoolArray
    sizes: Float64Array

    def as_table(self) -> Table:
        """Return the columns label, known, size [m] and probability_0 (free) to probability_C, one row per point."""
        columns = {"label": self.labels, "known": self.known, "size": self.sizes}
        return Table(columns | {f"probability_{c}": values for c, values in enumerate(self.probabilities.T)})


class StoredMap:
    """Map of one robot after one tick, or the centralised map (``robot_id`` 'central').

    ``frame_id`` is the name of its frame: 'team', or '<robot>/map' for the map frame of a robot where robots find each
    other's frames during the run.

    A map on which robots agree is the mean over ``num_robots`` robots, N: those that reached it over links at the time,
    or all with rule 'flood'. ``map_kind`` 'posterior' (the default of all methods) gives h_0 + N (h - h_0), the
    posterior of the evidence of these robots, and 'mean' the map h as the robot holds it. Both are the same where N is
    1: for a robot without links, for the centralised map, for evidence, for the baseline rules, whose map is no mean,
    and where ``evidence`` is an average. ``octree`` holds h - h_0.
    """

    def __init__(
        self,
        octree: SemanticOctree,
        robot_id: str,
        tick: int,
        stamp_ns: int,
        prior: float,
        num_robots: int,
        frame_id: str = TEAM,
        most_bytes: int | None = None,
    ) -> None:
        self.robot_id = robot_id
        self.tick = tick
        self.stamp_ns = stamp_ns
        self.prior = prior
        self.num_robots = num_robots
        self.frame_id = frame_id
        self.octree = octree
        self._most_bytes = most_bytes

    def __dir__(self) -> list[str]:
        return public_names(self)

    @property
    def resolution(self) -> float:
        """Edge of the finest leaf in metres."""
        return float(self.octree.resolution)

    def cut(self, bounds: Sequence[float]) -> StoredMap:
        """Return the cells of the map in a box; all other cells are unknown.

        ``bounds`` are those of a run, in the map's frame [m]: (zmin, zmax) or (xmin, ymin, zmin, xmax, ymax, zmax). A
        cell is inside where its centre is, or where it is on a minimum. ``Result.map`` with ``bounds`` reads less.

        Raises ConfigError for other numbers, a minimum that is not below its maximum, and a box without a cell's
        centre.
        """
        return self._with_octree(cut(self.octree, key_box(bounds, self.resolution)))

    def coarsened(self, max_depth: int | None) -> StoredMap:
        """Return the map with the nodes at a depth of the octree as its finest cells; all cells for None.

        ``max_depth`` is from 1 to 19, counted from the root as in OctoMap: 19 are the finest cells, and each level less
        doubles their edge (``resolution``). Larger leaves stay. A coarse cell takes the values of that known cell in it
        whose label has the largest log-odds, so that it is occupied if one of its cells is. Raises ConfigError for
        another depth.
        """
        if max_depth is None:
            return self
        if not 1 <= max_depth <= KEY_BITS:
            raise ConfigError(f"max_depth: {max_depth} is not a depth from 1 to {KEY_BITS}, the finest cells")
        return self._with_octree(coarsened(self.octree, max_depth))

    def _with_octree(self, octree: SemanticOctree) -> StoredMap:
        """Map with another octree."""
        return StoredMap(
            octree, self.robot_id, self.tick, self.stamp_ns, self.prior, self.num_robots, self.frame_id,
            self._most_bytes,
        )  # fmt: skip

    def shown_octree(self, map_kind: str = POSTERIOR) -> SemanticOctree:
        """Return the octree of a form of the map: N (h - h_0) or h - h_0. Raises ValueError for another form."""
        if map_kind not in MAP_KINDS:
            raise ValueError(f"map_kind: '{map_kind}' is not one of {', '.join(MAP_KINDS)}")
        if map_kind == MEAN or self.num_robots == 1:
            return self.octree
        return scaled_map(self.octree, float(self.num_robots))

    def title(self, map_kind: str = POSTERIOR) -> str:
        """Return a phrase that says which form of the map is shown."""
        if self.num_robots == 1:
            return "centralised map" if self.robot_id == CENTRAL else "own map"
        return f"{'mean' if map_kind == MEAN else 'posterior'} of {self.num_robots} robots"

    def leaves(self, *, map_kind: str = POSTERIOR) -> LeafTable:
        """Return all leaves, including free ones, in Morton order.

        Raises InputError where they would take more memory than a map in a file of the result's size can.
        """
        octree = self.shown_octree(map_kind)
        try:
            return octree.leaves(prior=self.prior, most_bytes=self._most_bytes)
        except ValueError as error:
            raise InputError(f"map of robot '{self.robot_id}': {error}; the result is damaged") from error

    def as_table(self, *, map_kind: str = POSTERIOR) -> Table:
        """Return all leaves as a table, one row per leaf, in Morton order. Raises as ``leaves``.

        The columns are x, y, z, size [m], label (0 for free), probability of that label, and log_odds_1 to log_odds_C.
        """
        leaves = self.leaves(map_kind=map_kind)
        columns = dict(leaves.as_table().columns)
        place = {name: columns.pop(name) for name in ("x", "y", "z", "size")}
        labels = {"label": best_labels(leaves.log_odds), "probability": label_probabilities(leaves.log_odds)}
        return Table({**place, **labels, **columns})

    def query(self, points: npt.ArrayLike, *, map_kind: str = POSTERIOR) -> PointQuery:
        """Return the state at points (P, 3), in metres in the team's frame. Raises ValueError for another shape."""
        coords = np.asarray(points, dtype=np.float64)
        if coords.ndim != 2 or coords.shape[1] != 3:
            raise ValueError(f"points: expects an array (P, 3), got {coords.shape}")
        deviation, known, sizes = self.shown_octree(map_kind).lookup(coords)
        log_odds = (deviation + np.float32(self.prior)).astype(np.float32)
        probabilities = class_probabilities(log_odds).astype(np.float32)
        return PointQuery(log_odds, probabilities, best_labels(log_odds), known, np.where(known, sizes, 0.0))

    def query_box(self, lower: npt.ArrayLike, upper: npt.ArrayLike, *, map_kind: str = POSTERIOR) -> LeafTable:
        """Return the leaves that overlap a box with corners ``lower`` and ``upper`` (3,), metres in the team's frame.

        Raises ValueError where a corner does not have three numbers, or a lower bound is above its upper bound.
        """
        low, high = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
        if low.shape != (3,) or high.shape != (3,):
            raise ValueError(f"box: expects two corners of three numbers, got {low.shape} and {high.shape}")
        if not (low <= high).all():
            raise ValueError("box: every lower bound must be at most its upper bound")
        table = self.leaves(map_kind=map_kind)
        half = table.sizes[:, None] / 2
        inside = ((table.centers + half > low) & (table.centers - half < high)).all(axis=1)
        return LeafTable(table.centers[inside], table.sizes[inside], table.log_odds[inside])


def joined_map(parts: Iterable[StoredMap], most_bytes: int | None = None) -> StoredMap:
    """Return one map of parts of it, at least one, whose cells are in different nodes of the octree.

    ``most_bytes`` is the limit of its leaves in memory. At most two parts are in memory at a time if they are made one
    by one.
    """
    all_parts = iter(parts)
    first = next(all_parts)
    second = next(all_parts, None)
    if second is None:
        return first
    octree = SemanticOctree(first.resolution, first.octree.num_classes)
    for part in itertools.chain((first, second), all_parts):
        octree.overwrite(part.octree, np.arange(part.octree.num_bricks))
    return StoredMap(
        octree, first.robot_id, first.tick, first.stamp_ns, first.prior, first.num_robots, first.frame_id, most_bytes
    )


def key_box(bounds: Sequence[float], resolution: float) -> KeyBox:
    """Return the cells in a box that ``StoredMap.cut`` takes. Raises ConfigError as ``StoredMap.cut``."""
    box = KeyBox.of(region_of(bounds), resolution)
    if box.is_empty:
        raise ConfigError(
            f"bounds: no cell of the map has its centre in the box; give a box with edges of at least {resolution:g} m"
        )
    return box
