"""Answers to queries at points and in a box of a robot's map, one tile of a result after the other."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from octoreplay.mapping.key_box import KeyBox
from octoreplay.records import POSTERIOR, Float64Array, Int64Array, LeafTable
from octoreplay.result import Result
from octoreplay.stored_map import PointQuery, StoredMap


class MapAnswer(NamedTuple):
    """Answer to a query.

    - ``stored``: a part of the map, which gives its time, frame and form.
    - ``points``: state at the points; None without points.
    - ``box``: leaves that overlap the box; None without a box.
    """

    stored: StoredMap
    points: PointQuery | None
    box: LeafTable | None


def answer_query(
    result: Result, robot_id: str, at_ns: int | None = None, *, points: Sequence[Sequence[float]] = (),
    box: Sequence[float] | None = None, map_kind: str = POSTERIOR,
) -> MapAnswer:  # fmt: skip
    """Return the state of a robot's map at points (P, 3), and its leaves in a box (xmin, ymin, zmin, xmax, ...) [m].

    Only tiles with a point, or in the box, are read. A leaf is at most as large as a tile. Raises as ``Result.map``,
    ``StoredMap.query`` and ``StoredMap.query_box``.
    """
    coords = np.asarray(points, np.float64).reshape(-1, 3)
    parts = list(result.boxes())
    of_part = _parts_of(coords, parts, result.config.map.resolution)
    read = [n for n, part in enumerate(parts) if (of_part == n).any() or (box is not None and _overlap(part, box))]
    stored: StoredMap | None = None
    answers, rows, leaves = [], [], []
    for number in read or [0]:
        stored = result.map(robot_id, at_ns=at_ns, bounds=parts[number])
        chosen = np.flatnonzero(of_part == number)
        rows.append(chosen)
        answers.append(stored.query(coords[chosen], map_kind=map_kind))
        if box is not None:
            leaves.append(stored.query_box(box[:3], box[3:], map_kind=map_kind))
    assert stored is not None
    return MapAnswer(
        stored,
        _in_order(answers, np.concatenate(rows)) if len(coords) else None,
        LeafTable.joined(leaves) if leaves else None,
    )


def _parts_of(coords: Float64Array, parts: Sequence[Sequence[float]], resolution: float) -> Int64Array:
    """Number (P,) of the part with the cell of each point; 0, where it is as unknown, for points outside all parts."""
    keys, found = np.floor(coords / resolution), np.zeros(len(coords), np.int64)
    for number, part in enumerate(parts):
        if len(part):
            box = KeyBox.of(part, resolution)
            found[((keys >= box.low) & (keys < box.high)).all(axis=1)] = number
    return found


def _overlap(part: Sequence[float], box: Sequence[float]) -> bool:
    """True where a part, all space if it is empty, and a box overlap or touch."""
    return all(part[axis] <= box[axis + 3] and part[axis + 3] >= box[axis] for axis in range(3)) if len(part) else True


def _in_order(answers: Sequence[PointQuery], rows: Int64Array) -> PointQuery:
    """Answers at all points, from those of parts with the points ``rows`` (P,)."""
    order = np.argsort(rows)
    return PointQuery(
        **{
            item.name: np.concatenate([getattr(answer, item.name) for answer in answers])[order]
            for item in dataclasses.fields(PointQuery)
        }
    )
