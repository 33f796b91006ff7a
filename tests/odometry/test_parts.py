"""Parts of odometry: times of points, parts of motions, and the information of a scene."""

from __future__ import annotations

import numpy as np
import pytest

from octoreplay.odometry.motion import part_of
from octoreplay.odometry.registration import least_information
from octoreplay.odometry.scans import times_after
from octoreplay.transforms import pose_matrix

SECOND = 1_000_000_000
STAMP = 1_700_000_000 * SECOND
SWEEP = np.linspace(0.0, 0.1, 11)


@pytest.mark.parametrize(
    "field",
    [
        (SWEEP * 1e9).astype("u4"),
        (SWEEP * 1e6).astype("u4"),
        SWEEP.astype("f4"),
        SWEEP * 1e3,
        1_700_000_000 + SWEEP,
        (1_700_000_000 + SWEEP) * 1e9,
        # A clock that began elsewhere: the times count from the first point.
        5_000.0 + SWEEP,
    ],
)
def test_times_of_any_unit_and_origin_count_from_the_stamp(field) -> None:
    np.testing.assert_allclose(times_after(field, STAMP), SWEEP, atol=2e-6)


def test_times_before_the_stamp_are_negative() -> None:
    np.testing.assert_allclose(times_after((SWEEP - 0.1).astype("f4"), STAMP), SWEEP - 0.1, atol=1e-6)


@pytest.mark.parametrize(
    "field", [np.zeros(5, "u4"), np.array([0.0, np.nan]), np.empty(0), np.array([-1.7e308, 1.7e308])]
)
def test_fields_without_times_are_not_used(field) -> None:
    assert times_after(field, STAMP) is None


def test_parts_of_a_motion_add_up_to_it() -> None:
    half = np.sin(0.2)
    motion = pose_matrix((0.0, 0.0, 1.0), (0.0, 0.0, half, np.cos(0.2)))
    part = part_of(motion, 0.25)
    np.testing.assert_allclose(part @ part @ part @ part, motion, atol=1e-12)
    np.testing.assert_allclose(part_of(motion, -1.0), np.linalg.inv(motion), atol=1e-12)


def test_a_room_determines_every_motion_and_a_wall_or_a_tunnel_does_not() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (600, 3)) * (5, 4, 2)
    axis = rng.integers(0, 3, 600)
    sign = rng.choice([-1.0, 1.0], 600)
    points[np.arange(600), axis] = sign * np.array((5, 4, 2))[axis]
    normals = np.eye(3)[axis]
    assert least_information(points, normals) > 0.02
    tunnel = axis != 0
    assert least_information(points[tunnel], normals[tunnel]) < 1e-12
    wall = axis == 1
    assert least_information(points[wall], normals[wall]) < 1e-12
    assert least_information(points[:5], normals[:5]) == 0.0


def test_the_information_does_not_depend_on_the_size_of_the_scene() -> None:
    rng = np.random.default_rng(1)
    points, normals = rng.standard_normal((200, 2)), rng.standard_normal((200, 2))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    assert least_information(10 * points, normals) == pytest.approx(least_information(points, normals))
