"""Tests of the exploration: clearance, motion limits, coverage and path search."""

from __future__ import annotations

import heapq

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from octoreplay.simulate.exploration import Motion, explore
from octoreplay.simulate.grid import CELL, shortest_paths
from octoreplay.simulate.village import make_village
from support.long_suite import long

PERIOD = 0.1


LARGE = [pytest.param((70.0, 6, seed), marks=pytest.mark.long) for seed in (0, 5)]


@pytest.fixture(scope="module", params=[*LARGE, (26.0, 4, 1)], ids=str)
def drive(request):
    size, num_robots, seed = request.param
    world = make_village(size, seed)
    return world, explore(world, num_robots, 601, PERIOD)


def cells_of(world, xy: np.ndarray) -> np.ndarray:
    return np.floor((xy + world.size / 2) / CELL).astype(int)


@long
def test_robots_keep_clear_of_obstacles_and_the_edge(drive):
    world, exploration = drive
    # One cell of distance is at least half a metre between the robot's centre and an obstacle.
    blocked = np.argwhere(world.obstacle_mask(CELL)) * CELL - world.size / 2
    visited = np.unique(cells_of(world, exploration.states[..., :2].reshape(-1, 2)), axis=0)
    for low in visited * CELL - world.size / 2:
        gap = np.maximum(np.abs(blocked - low) - CELL, 0.0)
        assert np.hypot(*gap.T).min() >= 0.5 - 1e-9
    assert (np.abs(exploration.states[..., :2]) <= world.size / 2 - 0.5).all()


def test_motion_is_within_the_limits(drive):
    _, exploration = drive
    steps = np.diff(exploration.states, axis=1)
    speed = np.hypot(steps[..., 0], steps[..., 1]) / PERIOD
    assert speed.max() <= Motion().speed + 1e-9
    assert np.abs(steps[..., 2]).max() <= Motion().turn_rate * PERIOD + 1e-9
    # Robots drive along their heading.
    heading = exploration.states[:, 1:, 2]
    ahead = steps[..., 0] * np.cos(heading) + steps[..., 1] * np.sin(heading)
    np.testing.assert_allclose(ahead, speed * PERIOD, atol=1e-9)


def test_robots_keep_clear_of_each_other(drive):
    _, exploration = drive
    states = exploration.states
    for a in range(len(states)):
        for b in range(a):
            distance = np.hypot(*(states[a, :, :2] - states[b, :, :2]).T)
            assert distance.min() > 0.9


def test_every_robot_keeps_moving(drive):
    _, exploration = drive
    steps = np.diff(exploration.states, axis=1)
    length = np.hypot(steps[..., 0], steps[..., 1]).sum(axis=1)
    assert (length > 0.6 * 60.0 * Motion().speed).all()


def test_robots_see_different_parts_that_overlap(drive):
    world, exploration = drive
    seen = exploration.first_seen >= 0
    team = seen.any(axis=0)
    if world.size > 50:
        assert (seen.sum(axis=(1, 2)) / team.sum()).max() < 0.6
        assert team.mean() > 0.35
    else:
        assert team.mean() > 0.7
    # Some cells must be seen by several robots for a consensus.
    assert (seen.sum(axis=0) > 1).sum() > 0.05 * team.sum()


def test_cells_behind_walls_are_not_seen(drive):
    world, exploration = drive
    first = exploration.first_seen[0]
    from scipy.ndimage import label

    # The inside of closed houses cannot be seen from outside.
    inside, count = label(~world.obstacle_mask(CELL))
    sizes = np.bincount(inside.ravel())
    rooms = [k for k in range(1, count + 1) if 20 < sizes[k] < 400]
    assert rooms
    for room in rooms:
        # Robots detect cells next to them through walls, so a rim may be known.
        assert (first[inside == room] < 0).mean() > 0.3


def test_exploration_is_deterministic():
    world = make_village(26.0, 2)
    first, second = (explore(world, 3, 150, PERIOD) for _ in range(2))
    np.testing.assert_array_equal(first.states, second.states)
    np.testing.assert_array_equal(first.first_seen, second.first_seen)


def test_a_single_robot_explores_and_progress_ends_at_one():
    shares: list[float] = []
    exploration = explore(make_village(24.0, 0), 1, 200, PERIOD, progress=shares.append)
    assert np.hypot(*np.diff(exploration.states[0, :, :2], axis=0).T).sum() > 10.0
    assert shares == sorted(shares)
    assert shares[-1] == 1.0


def test_many_robots_start_apart():
    world = make_village(40.0, 0)
    places = explore(world, 20, 2, PERIOD).states[:, 0, :2]
    distance = np.hypot(*(places[:, None] - places[None]).transpose(2, 0, 1)) + 10.0 * np.eye(20)
    assert distance.min() >= 1.2


def reference_dijkstra(passable: np.ndarray, start: tuple[int, int]) -> dict[tuple[int, int], float]:
    """Reference implementation of the shortest paths."""
    best = {start: 0.0}
    queue = [(0.0, start)]
    while queue:
        length, (i, j) = heapq.heappop(queue)
        if length > best[i, j]:
            continue
        for di in (-1, 0, 1):
            for dj in (-1, 0, 1):
                a, b = i + di, j + dj
                if (di, dj) == (0, 0) or not (0 <= a < passable.shape[0] and 0 <= b < passable.shape[1]):
                    continue
                if not (passable[a, b] and passable[i, b] and passable[a, j]):
                    continue
                reached = length + float(np.hypot(di, dj))
                if reached < best.get((a, b), np.inf):
                    best[a, b] = reached
                    heapq.heappush(queue, (reached, (a, b)))
    return best


@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1), st.integers(2, 9), st.integers(2, 9), st.floats(0.3, 1.0))
def test_shortest_paths_equal_the_reference(seed, rows, columns, density):
    rng = np.random.default_rng(seed)
    passable = rng.random((rows, columns)) < density
    start = (int(rng.integers(rows)), int(rng.integers(columns)))
    passable[start] = True
    cells, distance, previous = shortest_paths(passable, np.array(start))
    expected = reference_dijkstra(passable, start)
    for k, cell in enumerate(map(tuple, cells.tolist())):
        assert distance[k] == pytest.approx(expected.get(cell, np.inf))
        if np.isfinite(distance[k]) and cell != start:
            before = cells[previous[k]]
            assert np.abs(before - cells[k]).max() == 1
            assert distance[k] == pytest.approx(distance[previous[k]] + np.hypot(*(before - cells[k])))


@pytest.mark.parametrize(("size", "seed"), [(40.0, 0), pytest.param(90.0, 3, marks=long)])
def test_planning_in_the_seen_window_equals_planning_on_the_whole_map(monkeypatch, size, seed):
    world = make_village(size, seed)
    found = explore(world, 2, 200, PERIOD)
    num_seen = []

    def whole(team):
        num_seen.append((team.last_seen >= 0).mean())
        return slice(0, team.grid.n), slice(0, team.grid.n)

    monkeypatch.setattr("octoreplay.simulate.exploration._Team._seen_window", whole)
    np.testing.assert_array_equal(explore(world, 2, 200, PERIOD).states, found.states)
    # Most of the map is outside of the window at first.
    assert num_seen[0] < 0.2
