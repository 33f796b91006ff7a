"""Tests of odometry drift against its stated model, and of robots' own frames."""

from __future__ import annotations

import math

import numpy as np
import pytest

from octoreplay.geodesy import enu_points
from octoreplay.simulate.odometry import FIX_ORIGIN, MAX_TILT, drift_corrections, own_frame, position_fixes


def straight_way(length: float, step: float) -> np.ndarray:
    """Poses (T, 4, 4) along x."""
    x = np.arange(0.0, length + step / 2, step)
    poses = np.tile(np.eye(4), (len(x), 1, 1))
    poses[:, 0, 3] = x
    return poses


def end_errors(length: float, percent: float, degrees: float, *, num_steps: int = 10) -> np.ndarray:
    """Errors (600, 5) at the end of a straight way: x, y, z [m], heading and tilt [degrees]."""
    way = straight_way(length, length / num_steps)
    rows = []
    for seed in range(600):
        D = drift_corrections(way, percent, degrees, np.random.default_rng(seed))[-1]
        heading, tilt = math.atan2(D[1, 0], D[0, 0]), math.acos(min(1.0, D[2, 2]))
        rows.append([*(D @ way[-1] - way[-1])[:3, 3], math.degrees(heading), math.degrees(tilt)])
    return np.array(rows)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt((values**2).sum(axis=-1).mean()))


@pytest.mark.parametrize("num_steps", [5, 50])
def test_after_fifty_metres_the_deviations_are_the_given_ones(num_steps):
    errors = end_errors(50.0, 2.0, 0.0, num_steps=num_steps)
    assert rms(errors[:, :2]) == pytest.approx(1.0, rel=0.08)
    assert not errors[:, 3:].any()
    errors = end_errors(50.0, 0.0, 0.4, num_steps=num_steps)
    assert errors[:, 3].std() == pytest.approx(2.0, rel=0.08)
    assert abs(errors[:, 3].mean()) < 0.25


@pytest.mark.parametrize("length", [5.0, 200.0])
def test_the_systematic_part_grows_with_the_way_and_the_random_part_with_its_root(length):
    expected = math.sqrt(0.9 * length**2 + 0.1 * 50.0 * length)
    assert rms(end_errors(length, 1.0, 0.0)[:, :2]) == pytest.approx(0.01 * expected, rel=0.08)
    assert end_errors(length, 0.0, 0.5)[:, 3].std() == pytest.approx(0.05 * expected, rel=0.08)


def test_the_error_across_a_way_without_turns_is_random_only():
    errors = end_errors(50.0, 2.0, 0.0)
    assert errors[:, 1].std() == pytest.approx(math.sqrt(0.05), rel=0.08)


def test_height_and_tilt_stay_bounded():
    for length in (100.0, 400.0):
        errors = end_errors(length, 1.0, 0.5)
        assert errors[:, 2].std() == pytest.approx(0.1, rel=0.1)
        # Roll and pitch have 0.1 degrees each.
        assert rms(errors[:, 4:]) == pytest.approx(0.1 * math.sqrt(2), rel=0.1)


def test_the_error_of_the_heading_bends_the_way():
    way = straight_way(40.0, 0.5)
    D = drift_corrections(way, 0.0, 1.0, np.random.default_rng(3))
    headings = np.arctan2(D[:, 1, 0], D[:, 0, 0])
    moved = np.diff((D @ way)[:, :2, 3], axis=0)
    np.testing.assert_allclose(np.arctan2(moved[:, 1], moved[:, 0]), headings[:-1], atol=1e-4)
    np.testing.assert_allclose(np.hypot(*moved.T), 0.5)


def test_drift_moves_with_the_frame_that_the_way_is_given_in():
    way = straight_way(20.0, 0.5)
    turned = np.array([[0.0, -1.0, 0.0, 3.0], [1.0, 0.0, 0.0, -2.0], [0.0, 0.0, 1.0, 1.0], [0.0, 0.0, 0.0, 1.0]])
    along = drift_corrections(way, 0.0, 1.0, np.random.default_rng(0)) @ way
    across = drift_corrections(turned @ way, 0.0, 1.0, np.random.default_rng(0)) @ turned @ way
    np.testing.assert_allclose(across[:, :2], (turned @ along)[:, :2], atol=0.02)
    np.testing.assert_allclose(across[:, :2, 3], (turned @ along)[:, :2, 3], atol=1e-9)


def test_the_first_pose_and_robots_that_do_not_move_have_no_error():
    turning = np.tile(np.eye(4), (9, 1, 1))
    angles = np.linspace(0.0, 3.0, 9)
    turning[:, 0, 0] = turning[:, 1, 1] = np.cos(angles)
    turning[:, 1, 0], turning[:, 0, 1] = np.sin(angles), -np.sin(angles)
    turning[:, :3, 3] = 1.0, 2.0, 3.0
    D = drift_corrections(turning, 5.0, 5.0, np.random.default_rng(0))
    np.testing.assert_allclose(D, np.broadcast_to(np.eye(4), D.shape), atol=1e-12)
    D = drift_corrections(straight_way(10.0, 1.0), 5.0, 5.0, np.random.default_rng(0))
    np.testing.assert_allclose(D[0], np.eye(4), atol=1e-12)
    assert np.abs(D[-1] - np.eye(4)).max() > 0.01


def test_a_longer_way_begins_with_the_drift_of_a_shorter_one():
    short, longer = (drift_corrections(straight_way(s, 1.0), 1.0, 0.5, np.random.default_rng(1)) for s in (10.0, 30.0))
    np.testing.assert_array_equal(longer[: len(short)], short)


def test_own_frames_start_at_the_pose_with_x_forward_and_a_small_tilt():
    heading = 2.5
    pose = np.eye(4)
    pose[:2, :2] = [[math.cos(heading), -math.sin(heading)], [math.sin(heading), math.cos(heading)]]
    pose[:3, 3] = 4.0, -5.0, 0.5
    frames = np.array([own_frame(pose, np.random.default_rng(seed)) for seed in range(300)])
    np.testing.assert_array_equal(frames[:, :3, 3], np.broadcast_to(pose[:3, 3], (300, 3)))
    tilts = np.arccos(frames[:, 2, 2])
    assert tilts.max() <= MAX_TILT
    assert tilts.max() > 0.95 * MAX_TILT
    assert tilts.mean() == pytest.approx(MAX_TILT / 2, rel=0.15)
    np.testing.assert_allclose(np.arctan2(frames[:, 1, 0], frames[:, 0, 0]), heading, atol=2e-4)


def test_half_of_the_variance_of_fixes_is_common_to_all():
    true = np.array([(3.0, -4.0, 1.0)] * 50)
    draws = [enu_points(position_fixes(true, 2.0, np.random.default_rng(k)), FIX_ORIGIN) - true for k in range(800)]
    errors = np.array(draws)
    np.testing.assert_allclose(errors.std(axis=(0, 1)), (2.0, 2.0, 4.0), rtol=0.06)
    np.testing.assert_allclose(errors.mean(axis=1).std(axis=0), np.array([2.0, 2.0, 4.0]) * math.sqrt(0.51), rtol=0.08)
