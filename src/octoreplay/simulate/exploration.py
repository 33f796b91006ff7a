"""Coordinated exploration of a world by a team of robots on one shared 2-D map.

Frontiers are free cells next to unseen cells (Yamauchi, A Frontier-Based Approach for Autonomous Exploration, CIRA
1997). A robot chooses the frontier with the largest unseen area minus path cost; frontiers near another robot's goal
have a penalty (Burgard, Moors, Stachniss and Schneider, Coordinated Multi-Robot Exploration, T-RO 2005). Without
frontiers robots patrol: they choose the area that was seen longest ago in the same way.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from octoreplay.records import BoolArray, Float64Array, Int64Array
from octoreplay.simulate.grid import CELL, DrivingGrid, obstacle_distance, shortest_paths, wrapped
from octoreplay.simulate.world import World


@dataclass(frozen=True)
class Motion:
    """Motion and view of a robot; the defaults are a Clearpath Husky with a wide-angle camera.

    ``speed`` [m/s], ``turn_rate`` [rad/s]. ``clearance`` [m] is the least distance between the centres of the robot's
    cell and an obstacle's cell. ``view_range`` [m] and ``view_angle`` [rad] define the visible sector.
    """

    speed: float = 1.0
    turn_rate: float = 1.0
    clearance: float = 1.0
    view_range: float = 6.0
    view_angle: float = 1.75


@dataclass(frozen=True, eq=False)
class Exploration:
    """Trajectories of a team: ``states`` (N, T, 3) float64 of x, y [m] and heading [rad], one every ``period`` [s].

    ``first_seen`` (N, n, n) int32 is the step at which a robot first saw a cell of the map, -1 for unseen cells.
    """

    period: float
    states: Float64Array
    first_seen: npt.NDArray[np.int32]


def explore(
    world: World,
    num_robots: int,
    num_steps: int,
    period: float,
    *,
    motion: Motion | None = None,
    headings: Float64Array | None = None,
    progress: Callable[[float], None] | None = None,
) -> Exploration:
    """Drive a team through a world for ``num_steps`` states, ``period`` [s] apart.

    The robots start on a ring around the origin with ``headings`` (N,) [rad]; by default all head along x, so that
    their first views overlap. The result is deterministic; ties go to the lower index. ``progress`` is called with the
    finished share, 0 to 1.
    """
    team = _Team(world, num_robots, num_steps, period, motion or Motion())
    if headings is not None:
        team.states[:, 0, 2] = headings
    for step in range(num_steps):
        team.observe(step)
        if step + 1 < num_steps:
            team.move(step)
        if progress is not None:
            progress((step + 1) / num_steps)
    return Exploration(period, team.states, team.first_seen)


class _Team:
    """States of the robots and the map that they share."""

    def __init__(self, world: World, num_robots: int, num_steps: int, period: float, motion: Motion) -> None:
        self.grid = DrivingGrid(world)
        self.period = period
        self.motion = motion
        self.first_seen = np.full((num_robots, self.grid.n, self.grid.n), -1, dtype=np.int32)
        self.last_seen = np.full((self.grid.n, self.grid.n), -1, dtype=np.int32)
        self.states = np.zeros((num_robots, num_steps, 3))
        self.states[:, 0] = self._start(num_robots)
        self.paths: list[Float64Array | None] = [None] * num_robots
        self.goals: list[Int64Array | None] = [None] * num_robots
        self.passable = np.zeros((num_robots, self.grid.n, self.grid.n), dtype=np.bool_)
        self.planned_at = [-(10**9)] * num_robots
        self._rays = self._sector()

    def _start(self, num_robots: int) -> Float64Array:
        """States (N, 3) on a ring around the origin, heading along x, each moved to the nearest free cell."""
        ring = max(1.2, num_robots * 2.6 / (2 * math.pi)) if num_robots > 1 else 0.0
        free = np.argwhere(self.grid.distance >= self.motion.clearance)
        centers = self.grid.center(free)
        states = np.zeros((num_robots, 3))
        crowded = np.zeros(len(centers), dtype=np.bool_)
        for robot in range(num_robots):
            angle = 2 * math.pi * robot / num_robots
            wanted = ring * np.array([math.cos(angle), math.sin(angle)])
            distance = np.hypot(*(centers - wanted).T) + 1e6 * crowded
            states[robot, :2] = centers[int(np.argmin(distance))]
            crowded |= np.hypot(*(centers - states[robot, :2]).T) < 1.2
        return states

    def _sector(self) -> tuple[Float64Array, Float64Array]:
        """Angles of the rays in the visible sector and distances along them, dense enough to reach every cell."""
        reach, spread = self.motion.view_range, self.motion.view_angle
        count = math.ceil(spread * reach / CELL)
        return np.linspace(-spread / 2, spread / 2, count), np.arange(CELL / 2, reach, CELL / 2)

    def observe(self, step: int) -> None:
        """Mark the cells that each robot sees: its sector up to the first obstacles, and its surroundings."""
        angles, distances = self._rays
        for robot in range(len(self.states)):
            x, y, heading = self.states[robot, step]
            bearing = heading + angles
            direction = np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
            points = np.array([x, y]) + direction[:, None] * distances[None, :, None]
            cells = np.floor((points + self.grid.size / 2) / CELL).astype(np.int64)
            outside = ((cells < 0) | (cells >= self.grid.n)).any(axis=2)
            cells = np.clip(cells, 0, self.grid.n - 1)
            blocked = self.grid.obstacles[cells[..., 0], cells[..., 1]] | outside
            # The first obstacle on a ray is seen, cells behind it are not.
            behind = np.cumsum(blocked, axis=1) - blocked > 0
            self._mark(robot, step, cells[~behind & ~outside])
            # A robot also detects obstacles next to it.
            reach = math.ceil(1.5 / CELL)
            i, j = self.grid.cell(x, y)
            near = np.stack(np.meshgrid(np.arange(i - reach, i + reach + 1), np.arange(j - reach, j + reach + 1)), -1)
            near = near.reshape(-1, 2)
            self._mark(robot, step, near[((near >= 0) & (near < self.grid.n)).all(axis=1)])

    def _mark(self, robot: int, step: int, cells: Int64Array) -> None:
        """Mark cells (P, 2) as seen by a robot at a step."""
        first = self.first_seen[robot]
        i, j = cells[:, 0], cells[:, 1]
        new = first[i, j] < 0
        first[i[new], j[new]] = step
        self.last_seen[i, j] = step

    def move(self, step: int) -> None:
        """Drive every robot one step along its path, with a new path if one is due."""
        for robot in range(len(self.states)):
            if self._needs_plan(robot, step):
                self._plan(robot, step)
            self.states[robot, step + 1] = self._drive(robot, step)

    def _needs_plan(self, robot: int, step: int) -> bool:
        """True if the goal is reached or its surroundings have been seen since; at most once a second."""
        if (step - self.planned_at[robot]) * self.period < 1.0:
            return False
        path, goal = self.paths[robot], self.goals[robot]
        if path is None or goal is None:
            return True
        arrived = np.hypot(*(path[-1] - self.states[robot, step, :2])) < 1.0
        i, j = goal
        window = self.last_seen[max(0, i - 2) : i + 3, max(0, j - 2) : j + 3]
        return bool(arrived or (window >= self.planned_at[robot]).all())

    def _plan(self, robot: int, step: int) -> None:
        """Choose the best goal and the shortest path to it over known free cells."""
        self.planned_at[robot] = step
        self.paths[robot], self.goals[robot] = None, None
        window = self._seen_window()
        known = self.last_seen[window] >= 0
        clear = obstacle_distance(known & self.grid.obstacles[window]) >= self.motion.clearance
        passable = np.zeros_like(self.grid.obstacles)
        passable[window] = known & clear
        for other in range(len(self.states)):
            if other != robot:
                self._block(passable, self.states[other, step, :2], 1.2)
        start = self._nearest(passable, self.states[robot, step, :2])
        if start is None:
            return
        corner = np.array([window[0].start, window[1].start])
        cells, way, previous = shortest_paths(passable[window], start - corner)
        cells += corner
        cost = 0.6 * CELL * way + self._turning(robot, step, cells) + self._crowding(robot, step, cells)
        cost[way * CELL < 1.5] = np.inf
        best = None
        for novelty in (self._frontier_area(window), self._age(window, step)):
            utility = novelty[*(cells - corner).T] - cost
            best = int(np.argmax(utility))
            if np.isfinite(utility[best]):
                break
        else:
            return
        self.goals[robot] = cells[best]
        chain = [best]
        while previous[chain[-1]] >= 0:
            chain.append(int(previous[chain[-1]]))
        self.paths[robot] = self.grid.center(cells[chain[::-1]])
        self.passable[robot] = passable

    def _seen_window(self) -> tuple[slice, slice]:
        """Rectangle of the map that holds all seen cells; planning looks at nothing else.

        The margin is as wide as the filters reach, so that their values at seen cells are those of the whole map.
        """
        seen = self.last_seen >= 0
        margin = self._width() + math.ceil(self.motion.clearance / CELL)
        rows, columns = (
            slice(max(0, int(places[0]) - margin), min(self.grid.n, int(places[-1]) + 1 + margin))
            for places in (np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0)))
        )
        return rows, columns

    def _frontier_area(self, window: tuple[slice, slice]) -> Float64Array:
        """Unseen area in a window around each cell near a frontier [m^2]; -inf elsewhere."""
        from scipy.ndimage import uniform_filter

        unseen = self.last_seen[window] < 0
        width = self._width()
        area: Float64Array = uniform_filter(unseen.astype(np.float64), width, mode="constant") * (width * CELL) ** 2
        return np.where(self._frontier(unseen, ~self.grid.obstacles[window]), area, -np.inf)

    def _age(self, window: tuple[slice, slice], step: int) -> Float64Array:
        """Mean time in a window since the cells around each cell were last seen, clipped at 120 s [s]."""
        from scipy.ndimage import uniform_filter

        age: Float64Array = np.minimum((step - self.last_seen[window]) * self.period, 120.0)
        mean: Float64Array = uniform_filter(age, self._width(), mode="constant")
        return mean

    def _width(self) -> int:
        """Edge length in cells of the square that a robot sees well from its centre."""
        return 2 * math.ceil(0.5 * self.motion.view_range / CELL) + 1

    def _frontier(self, unseen: BoolArray, is_open: BoolArray) -> BoolArray:
        """Mask of free cells, seen and open, within the planner's clearance of a frontier of at least five cells."""
        from scipy.ndimage import binary_dilation, label

        free = ~unseen & is_open
        edge = free & binary_dilation(unseen, iterations=1)
        groups, count = label(edge, structure=np.ones((3, 3)))
        sizes = np.bincount(groups.ravel(), minlength=count + 1)
        large = edge & (sizes[groups] >= 5)
        reach = math.ceil(self.motion.clearance / CELL)
        near: BoolArray = binary_dilation(large, structure=np.ones((3, 3)), iterations=reach) & free
        return near

    def _turning(self, robot: int, step: int, cells: Int64Array) -> Float64Array:
        """Cost of turning towards each cell, which prevents alternating between goals on both sides."""
        x, y, heading = self.states[robot, step]
        offset = self.grid.center(cells) - (x, y)
        error = np.abs(wrapped(np.arctan2(offset[:, 1], offset[:, 0]) - heading))
        cost: Float64Array = 6.0 * error
        return cost

    def _crowding(self, robot: int, step: int, cells: Int64Array) -> Float64Array:
        """Cost of each cell that is near another robot or its goal."""
        cost = np.zeros(len(cells))
        centers = self.grid.center(cells)
        for other, goal in enumerate(self.goals):
            if other == robot:
                continue
            places = [self.states[other, step, :2]] + ([] if goal is None else [self.grid.center(goal)])
            for place in places:
                cost += 20.0 * np.clip(1.0 - np.hypot(*(centers - place).T) / 10.0, 0.0, None)
        return cost

    def _drive(self, robot: int, step: int) -> Float64Array:
        """Next state: turn towards a point ahead on the path and drive if the way is clear."""
        x, y, heading = self.states[robot, step]
        path = self.paths[robot]
        if path is None:
            return np.array([x, y, heading])
        target = self._look_ahead(robot, path, np.array([x, y]))
        error = float(wrapped(math.atan2(target[1] - y, target[0] - x) - heading))
        turn = max(-self.motion.turn_rate * self.period, min(self.motion.turn_rate * self.period, error))
        heading += turn
        # Full speed if the target is straight ahead, turning on the spot if it is behind.
        pace = self.motion.speed * self.period * max(0.0, math.cos(min(1.2 * abs(error), math.pi / 2)))
        pace = min(pace, math.hypot(target[0] - x, target[1] - y))
        ahead = np.array([x + pace * math.cos(heading), y + pace * math.sin(heading)])
        if not self._may_stand(robot, step, ahead):
            # If the robot already heads along the path, an unknown obstacle blocks it and a new plan is needed.
            if abs(error) < 0.05:
                self.paths[robot] = None
            ahead = np.array([x, y])
        return np.array([*ahead, heading])

    def _look_ahead(self, robot: int, path: Float64Array, here: Float64Array) -> Float64Array:
        """Farthest point of the path, up to 2 m ahead, that the robot can reach in a straight line."""
        nearest = int(np.argmin(np.hypot(*(path - here).T)))
        target: Float64Array = path[nearest]
        for ahead in path[nearest + 1 : nearest + 5]:
            along = ahead - here
            # A strip instead of a line, because steps of finite length may clip a corner that a line just misses.
            side = 0.06 * np.array([-along[1], along[0]]) / max(1e-9, float(np.hypot(*along)))
            line = here + np.linspace(0.0, 1.0, 40)[:, None] * along
            strip = np.concatenate([line - side, line + side])
            i, j = np.clip(np.floor((strip + self.grid.size / 2) / CELL).astype(np.int64), 0, self.grid.n - 1).T
            if not self.passable[robot, i, j].all():
                break
            target = ahead
        return target

    def _may_stand(self, robot: int, step: int, place: Float64Array) -> bool:
        """True if a position is clear of obstacles, and of other robots unless it increases the distance to them."""
        if self.grid.distance[self.grid.cell(*place)] < self.motion.clearance:
            return False
        here = self.states[robot, step, :2]
        for other in range(len(self.states)):
            if other == robot:
                continue
            # Robots with a lower index have already moved.
            there = self.states[other, step + 1 if other < robot else step, :2]
            if np.hypot(*(place - there)) < min(1.0, float(np.hypot(*(here - there)))):
                return False
        return True

    def _block(self, passable: BoolArray, place: Float64Array, radius: float) -> None:
        """Clear a disc in a mask."""
        reach = math.ceil(radius / CELL)
        i, j = self.grid.cell(*place)
        rows, columns = np.ogrid[max(0, i - reach) : min(self.grid.n, i + reach + 1),
                                 max(0, j - reach) : min(self.grid.n, j + reach + 1)]  # fmt: skip
        passable[rows, columns] &= np.hypot(rows - i, columns - j) * CELL > radius

    def _nearest(self, passable: BoolArray, place: Float64Array) -> Int64Array | None:
        """Nearest passable cell, None if it is 3 m away or more."""
        cells = np.argwhere(passable)
        if len(cells) == 0:
            return None
        distance = np.hypot(*(self.grid.center(cells) - place).T)
        best = int(np.argmin(distance))
        return cells[best] if distance[best] < 3.0 else None
