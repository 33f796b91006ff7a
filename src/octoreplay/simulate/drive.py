"""Drives along given paths: straight between waypoints, and around obstacles."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence

import numpy as np

from octoreplay.errors import ConfigError
from octoreplay.records import BoolArray, Float64Array
from octoreplay.simulate.exploration import Motion
from octoreplay.simulate.grid import CELL, DrivingGrid, shortest_paths, wrapped
from octoreplay.simulate.world import World

_DETOUR = 30.0
"""Distance beyond the box of two waypoints within which a way around obstacles is searched at first [m]."""

Path = Sequence[tuple[float, float]]


def drive_paths(world: World, paths: Mapping[str, Path], num_steps: int, period: float, motion: Motion) -> Float64Array:
    """Return states (N, T, 3) of x, y [m] and heading [rad] of robots that drive on ``paths`` by robot id.

    A robot starts at its first waypoint, drives at ``motion.speed``, turns on the spot at ``motion.turn_rate`` and
    stops at its last waypoint. A leg is the straight line between two waypoints, or a shortest path over the cells of
    the driving grid where an obstacle is nearer to the line than ``motion.clearance``. Robots do not avoid each other.
    Raises ConfigError for a waypoint that is near an obstacle or enclosed by obstacles.
    """
    grid = DrivingGrid(world)
    roomy = _largest_part(grid.distance >= motion.clearance)
    times = period * np.arange(num_steps, dtype=np.float64)
    return np.stack([_driven(_way(grid, roomy, robot_id, path), times, motion) for robot_id, path in paths.items()])


def _largest_part(free: BoolArray) -> BoolArray:
    """Mask (n, n) of the largest connected part of free cells (n, n): between its cells there is always a way."""
    from scipy.ndimage import label

    parts, count = label(free)
    sizes = np.bincount(parts[free], minlength=count + 1)
    largest: BoolArray = free & (parts == np.argmax(sizes))
    return largest


def _way(grid: DrivingGrid, roomy: BoolArray, robot_id: str, path: Path) -> Float64Array:
    """Corners (K, 2) of the way along a path over the cells of a mask [m], no two of them equal in a row."""
    points = np.array(path, dtype=np.float64)
    for number, (x, y) in enumerate(points.tolist(), 1):
        if not roomy[grid.cell(x, y)]:
            places = grid.center(np.argwhere(roomy))
            near = places[np.argmin(np.hypot(*(places - (x, y)).T))]
            raise ConfigError(
                f"paths: {robot_id}: obstacles are at or around waypoint {number} ({x:g}, {y:g}); the nearest place"
                f" with a way to it is ({near[0]:g}, {near[1]:g})"
            )
    corners = [points[:1]]
    for start, end in itertools.pairwise(points):
        if not _is_clear(grid, roomy, start, end):
            corners.append(_detour(grid, roomy, start, end))
        corners.append(end[None])
    way: Float64Array = np.concatenate(corners)
    moved = np.append(True, (np.diff(way, axis=0) != 0).any(axis=1))
    corners_moved: Float64Array = way[moved]
    return corners_moved


def _is_clear(grid: DrivingGrid, roomy: BoolArray, start: Float64Array, end: Float64Array) -> bool:
    """True if a straight line leads over cells of the mask only."""
    count = 2 + math.ceil(float(np.hypot(*(end - start))) / (CELL / 4))
    line = start + np.linspace(0.0, 1.0, count)[:, None] * (end - start)
    return all(roomy[grid.cell(x, y)] for x, y in line.tolist())


def _detour(grid: DrivingGrid, roomy: BoolArray, start: Float64Array, end: Float64Array) -> Float64Array:
    """Centres (K, 2) of the cells of a short way between two places over the cells of the mask [m]."""
    first, last = np.array(grid.cell(*start)), np.array(grid.cell(*end))
    reach = math.ceil(_DETOUR / CELL)
    # The surroundings are searched first, so that the time hardly depends on the size of the world.
    while True:
        low = np.maximum(np.minimum(first, last) - reach, 0)
        high = np.maximum(first, last) + reach + 1
        cells, way, previous = shortest_paths(roomy[low[0] : high[0], low[1] : high[1]], first - low)
        chain = np.flatnonzero((cells == last - low).all(axis=1)).tolist()
        if np.isfinite(way[chain[0]]):
            break
        reach *= 2
    while previous[chain[-1]] >= 0:
        chain.append(int(previous[chain[-1]]))
    return grid.center(cells[chain[::-1]] + low)


def _driven(way: Float64Array, times: Float64Array, motion: Motion) -> Float64Array:
    """States (T, 3) at times (T,) [s] after the start of a drive along corners (K, 2)."""
    legs = np.diff(way, axis=0)
    if not len(legs):
        return np.broadcast_to([*way[0], 0.0], (len(times), 3)).copy()
    headings = np.arctan2(legs[:, 1], legs[:, 0])
    turns = wrapped(np.diff(headings))
    headings = headings[0] + np.append(0.0, np.cumsum(turns))
    # The robot turns at every corner but the first: knots at the beginning and at the end of each leg.
    driving = np.hypot(*legs.T) / motion.speed
    turning = np.append(0.0, np.abs(turns) / motion.turn_rate)
    ends = np.cumsum(turning + driving)
    knots = np.stack([ends - driving, ends], axis=1).ravel()
    places = np.stack([way[:-1], way[1:]], axis=1).reshape(-1, 2)
    values = np.column_stack([places, np.repeat(headings, 2)])
    return np.column_stack([np.interp(times, knots, column) for column in values.T])
