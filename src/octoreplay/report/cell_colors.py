"""Colours of a map's leaves, for exports and pictures."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from octoreplay.config.class_tables.palette import PALETTE
from octoreplay.log_odds import best_labels, label_probabilities
from octoreplay.mapping.contradiction import CellContradiction, cell_contradictions, state_limits
from octoreplay.records import MEAN, BoolArray, ClassTable, Color, Float64Array, FloatArray, LeafTable, UInt8Array
from octoreplay.report.map_part import MapPart
from octoreplay.result import Result
from octoreplay.stored_map import StoredMap

COLORS = ("label", "height", "robot", "seen-by", "disagreement", "contradiction", "probability")
"""Quantities that colours show:

- 'label': colour of the most probable class; free leaves are grey
- 'height': height of the leaf's centre, from the lowest, dark, to the highest, yellow
- 'robot': mean colour of the robots with a map that knows the leaf's centre
- 'seen-by': colour of the only robot with scans of the leaf's centre; grey for several robots, darker for more of them
- 'disagreement': largest ||h_j - h|| over the other robots at the leaf's centre, from 0, dark, to the largest of all
  leaves, yellow (an unknown cell counts as the prior)
- 'contradiction': relation of the robots' evidence in the cell (``CellContradiction``)
- 'probability': probability of the label, from 1 / (C + 1), dark, to 1, yellow
"""
SCALED = ("height", "disagreement")
"""Quantities whose scale depends on the shown leaves."""
FREE_COLOR = (225, 225, 225)
CONTRADICTION_COLORS: dict[CellContradiction, tuple[str, Color]] = {
    CellContradiction.UNCOMPARED: ("known to fewer than two robots", (190, 190, 190)),
    CellContradiction.NONE: ("same", (0, 114, 178)),
    CellContradiction.OTHER_LABEL: ("other label", (240, 228, 66)),
    CellContradiction.CONTRADICTION: ("occupied and free", (230, 159, 0)),
    CellContradiction.CLEAR: ("occupied and firmly free", (204, 0, 0)),
}
"""Name and colour of each relation of the robots' evidence in a cell."""

_FEW, _MANY, _UNSEEN = 205, 60, (255, 255, 255)
"""Grey values of a cell that two robots have seen, and of one that all have; colour of a cell in no evidence."""
_RAMP = np.array(
    [[68, 1, 84], [72, 40, 120], [62, 74, 137], [49, 104, 142], [38, 130, 142], [31, 158, 137], [53, 183, 121],
     [109, 205, 89], [180, 222, 44], [253, 231, 37]], dtype=np.float64,
)  # fmt: skip
"""Matplotlib's viridis at ten even steps, from dark (low) to yellow (high)."""


class LeafColors(NamedTuple):
    """Colours of leaves.

    Attributes
    ----------
    colors : (L, 3) uint8
        Colours of the leaves.
    scale : str
        Meaning of the colours.
    limits : (float, float) or None
        Values of the dark and of the yellow end of a scale, None for colours that are no scale.
    """

    colors: UInt8Array
    scale: str
    limits: tuple[float, float] | None = None


def default_color(classes: ClassTable) -> str:
    """Return 'label', or 'height' for a map with a single class, which would have one colour."""
    return "label" if classes.num_classes > 1 else "height"


def leaf_colors(
    result: Result, shown: Sequence[StoredMap], leaves: LeafTable, color: str, part: MapPart,
    limits: tuple[float, float] | None = None,
) -> LeafColors:  # fmt: skip
    """Return the colours of leaves of the maps ``shown``, by one of ``COLORS``; ``part`` is what they show.

    The other maps that a colour compares are the same part of them. ``limits`` are the ends of a scale; None for those
    of the values. Raises InputError where a colour compares robots with maps in several frames, or without stored
    evidence.
    """
    if color == "label":
        return LeafColors(_label_colors(result.class_table, leaves), "the classes' own")
    if color == "height":
        z = leaves.centers[:, 2]
        low, high = limits or (float(z.min(initial=np.inf)), float(z.max(initial=-np.inf)))
        values = (z - low) / max(high - low, leaves.sizes.min(initial=1.0))
        return LeafColors(ramp(values), f"dark {low:g} m, yellow {high:g} m", (low, high))
    if color == "probability":
        least = 1.0 / (result.class_table.num_classes + 1)
        values = (label_probabilities(leaves.log_odds) - least) / (1.0 - least)
        return LeafColors(ramp(values), f"dark {least:.3f}, yellow 1", (least, 1.0))
    part.check_one_frame(result)
    if color in ("seen-by", "contradiction"):
        evidence = [part.evidence(result, robot_id) for robot_id in result.robots]
        return _seen_by(evidence, leaves) if color == "seen-by" else _contradiction(result, evidence, leaves)
    ids = {stored.robot_id: stored for stored in shown}
    maps = [ids.get(robot_id) or part.map(result, robot_id) for robot_id in result.robots]
    if color == "robot":
        known = np.column_stack([stored.query(leaves.centers, map_kind=MEAN).known for stored in maps])
        return LeafColors(_mean_colors(known), _robot_names(maps))
    values = _disagreement(shown[0], maps, leaves.centers)
    largest = limits[1] if limits else float(values.max(initial=0.0))
    return LeafColors(
        ramp(values / largest if largest > 0 else values), f"dark 0, yellow {largest:.6g}", (0.0, largest)
    )


def common_limits(limits: Iterable[tuple[float, float] | None]) -> tuple[float, float] | None:
    """Return the ends of one scale for all parts of a map, or for several maps; None where no colour is a scale."""
    ends = [pair for pair in limits if pair is not None]
    return (min(low for low, _ in ends), max(high for _, high in ends)) if ends else None


def ramp(values: FloatArray) -> UInt8Array:
    """Return colours (L, 3) uint8 of values (L,) in 0..1, from dark to yellow."""
    place = np.clip(values, 0.0, 1.0) * (len(_RAMP) - 1)
    steps = np.arange(len(_RAMP))
    return np.rint(np.column_stack([np.interp(place, steps, _RAMP[:, k]) for k in range(3)])).astype(np.uint8)


def robot_color(index: int) -> Color:
    """Return the colour of a robot by its index in the team."""
    return PALETTE[index % len(PALETTE)]


def _label_colors(class_table: ClassTable, leaves: LeafTable) -> UInt8Array:
    """Colours (L, 3) of the labels; free is grey."""
    palette = np.concatenate([np.array([FREE_COLOR], dtype=np.uint8), class_table.colors])
    return palette.take(best_labels(leaves.log_odds), axis=0)


def _robot_names(maps: Sequence[StoredMap]) -> str:
    """Robots with their colours."""
    return ", ".join(f"{stored.robot_id} {robot_color(index)}" for index, stored in enumerate(maps))


def _robot_palette(num_robots: int) -> Float64Array:
    """Colours (N, 3) of the robots."""
    return np.array([robot_color(index) for index in range(num_robots)], dtype=np.float64)


def _mean_colors(known: BoolArray) -> UInt8Array:
    """Mean colour (L, 3) of the robots that know a leaf, from (L, N)."""
    count = np.maximum(known.sum(axis=1, keepdims=True), 1)
    mean: Float64Array = known.astype(np.float64) @ _robot_palette(known.shape[1]) / count
    return (mean + 0.5).astype(np.uint8)


def _seen_by(evidence: Sequence[StoredMap], leaves: LeafTable) -> LeafColors:
    """Colour of the only robot with scans of a leaf; grey for several robots, darker for more of them."""
    known = np.column_stack([own.octree.lookup(leaves.centers)[1] for own in evidence])
    num_robots, count = known.shape[1], known.sum(axis=1)
    colors = _mean_colors(known)
    colors[count == 0] = _UNSEEN
    several = count > 1
    share = (count[several] - 2) / max(num_robots - 2, 1)
    colors[several] = np.rint(_FEW + (_MANY - _FEW) * share)[:, None].astype(np.uint8)
    names = f"{_robot_names(evidence)} for leaves with scans of one robot; grey: several robots"
    return LeafColors(colors, names if num_robots < 3 else f"{names}, from light, 2, to dark, {num_robots}")


def _contradiction(result: Result, evidence: Sequence[StoredMap], leaves: LeafTable) -> LeafColors:
    """Colour of the relation of the robots' evidence at the leaves' centres."""
    limits = state_limits(result.config.sensor)
    kinds = cell_contradictions([own.octree for own in evidence], leaves.centers, limits)
    palette = np.array([CONTRADICTION_COLORS[kind][1] for kind in CellContradiction], dtype=np.uint8)
    return LeafColors(palette[kinds], ", ".join(f"{name} {color}" for name, color in CONTRADICTION_COLORS.values()))


def _disagreement(own: StoredMap, maps: Sequence[StoredMap], points: Float64Array) -> FloatArray:
    """Largest distance (P,) float64 between one robot's log-odds and another's at points."""
    h = own.query(points, map_kind=MEAN).log_odds.astype(np.float64)
    largest = np.zeros(len(points))
    for other in maps:
        if other is not own:
            difference = other.query(points, map_kind=MEAN).log_odds - h
            np.maximum(largest, np.linalg.norm(difference, axis=1), out=largest)
    return largest
