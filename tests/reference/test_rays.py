from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from reference.rays import cells_before_end, coord_to_key, key_to_coord
from support.long_suite import examples

coordinate = st.floats(-3.0, 3.0, allow_nan=False).map(lambda value: round(value, 6))
point = st.tuples(coordinate, coordinate, coordinate)


def _walk(origin, target, resolution=1.0):
    return cells_before_end(origin, target, coord_to_key(target, resolution), resolution)


def test_ray_along_one_axis_passes_every_cell_before_the_end():
    assert _walk((0.5, 0.5, 0.5), (3.5, 0.5, 0.5)) == [(0, 0, 0), (1, 0, 0), (2, 0, 0)]
    assert _walk((0.5, 0.5, 0.5), (-2.5, 0.5, 0.5)) == [(0, 0, 0), (-1, 0, 0), (-2, 0, 0)]


def test_ray_that_ends_in_its_own_cell_passes_nothing():
    assert _walk((0.2, 0.2, 0.2), (0.9, 0.1, 0.4)) == []


def test_slanted_ray_crosses_walls_in_order_of_distance():
    # x walls at t = 0.2, 0.6, 1.0 (of 2.5), the y wall at t = 0.5.
    assert _walk((0.5, 0.5, 0.5), (3.0, 1.5, 0.5)) == [(0, 0, 0), (1, 0, 0), (1, 1, 0), (2, 1, 0)]


@pytest.mark.parametrize(
    ("target", "first_step"),
    [((2.5, 2.5, 0.5), (0, 1, 0)), ((2.5, 0.5, 2.5), (0, 0, 1)), ((0.5, 2.5, 2.5), (0, 0, 1)),
     ((2.5, 2.5, 2.5), (0, 0, 1)), ((-1.5, -1.5, -1.5), (0, 0, -1))],
)  # fmt: skip
def test_walls_crossed_together_are_crossed_z_then_y_then_x(target, first_step):
    assert _walk((0.5, 0.5, 0.5), target)[1] == first_step


def test_exact_diagonal_takes_z_y_x_in_turn():
    assert _walk((0.5, 0.5, 0.5), (2.5, 2.5, 2.5)) == [
        (0, 0, 0), (0, 0, 1), (0, 1, 1), (1, 1, 1), (1, 1, 2), (1, 2, 2),
    ]  # fmt: skip


def test_origin_on_a_wall_belongs_to_the_upper_cell():
    assert _walk((1.0, 0.5, 0.5), (-0.5, 0.5, 0.5)) == [(1, 0, 0), (0, 0, 0)]


def test_key_is_the_floor_of_the_quotient():
    assert coord_to_key((-0.01, 0.2, 0.39), 0.2) == (-1, 1, 1)
    assert key_to_coord((-1, 0, 2), 0.5) == (-0.25, 0.25, 1.25)


@given(origin=point, target=point, resolution=st.sampled_from([0.17, 0.25, 1.0]))
def test_traversal_is_a_path_of_face_neighbours_to_the_end_cell(origin, target, resolution):
    path = [*_walk(origin, target, resolution), coord_to_key(target, resolution)]
    assert path[0] == coord_to_key(origin, resolution)
    steps = np.abs(np.diff(np.array(path), axis=0))
    assert (steps.sum(axis=1) == 1).all()
    assert len(path) == 1 + np.abs(np.subtract(path[-1], path[0])).sum()


@given(origin=point, target=point, resolution=st.sampled_from([0.17, 0.25, 1.0]))
def test_every_passed_cell_touches_the_segment(origin, target, resolution):
    cells = np.array([*_walk(origin, target, resolution), coord_to_key(target, resolution)], dtype=float)
    lower, upper = cells * resolution - 1e-9, (cells + 1) * resolution + 1e-9
    direction = np.subtract(target, origin)
    entry, exit_ = np.zeros(len(cells)), np.ones(len(cells))
    for axis in range(3):
        if abs(direction[axis]) < 1e-12:
            assert ((lower[:, axis] <= origin[axis]) & (origin[axis] <= upper[:, axis])).all()
            continue
        a, b = (lower[:, axis] - origin[axis]) / direction[axis], (upper[:, axis] - origin[axis]) / direction[axis]
        entry, exit_ = np.maximum(entry, np.minimum(a, b)), np.minimum(exit_, np.maximum(a, b))
    assert (entry <= exit_ + 1e-9).all()


@examples(100)
@given(origin=point, target=point)
def test_cells_of_dense_samples_are_passed(origin, target):
    passed = {*_walk(origin, target, 0.25), coord_to_key(target, 0.25)}
    t = np.linspace(0.0, 1.0, 400)[:, None]
    samples = np.array(origin) * (1 - t) + np.array(target) * t
    scaled = samples / 0.25
    # Samples on a wall may be in either cell.
    inside = (np.abs(scaled - np.rint(scaled)) > 1e-6).all(axis=1)
    assert {coord_to_key(sample, 0.25) for sample in samples[inside]} <= passed
