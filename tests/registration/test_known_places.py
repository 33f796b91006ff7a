"""Poses of map frames from position fixes and from tags."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from octoreplay.registration.known_places import fit_fixes, fit_tags, tag_place
from octoreplay.transforms import inverse, pose_difference

RNG = np.random.default_rng


def pose(yaw=0.0, shift=(0.0, 0.0, 0.0), tilt=(0.0, 0.0)):
    T = np.eye(4)
    T[:3, :3] = (Rotation.from_euler("z", yaw) * Rotation.from_rotvec([*tilt, 0.0])).as_matrix()
    T[:3, 3] = shift
    return T


def moved(T, points):
    return points @ T[:3, :3].T + T[:3, 3]


def drive(n=60):
    """Positions (n, 3) along a bent way of about 40 m, one each second."""
    s = np.linspace(0.0, 40.0, n)
    return np.stack([s, 5.0 * np.sin(s / 8.0), 0.1 * np.cos(s)], axis=1)


def fitted(points, enu, sigma=math.nan, seconds=None):
    times = np.arange(len(points), dtype=float) if seconds is None else seconds
    return fit_fixes(points, enu, np.full((len(points), 2), sigma), times)


TRUE = pose(2.1, (120.0, -40.0, 7.0))


def test_exact_fixes_give_the_frame():
    found = fitted(drive(), moved(TRUE, drive()))
    assert not found.refusal
    assert pose_difference(found.T, TRUE) == pytest.approx((0, 0), abs=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_errors_stay_within_the_standard_deviations(seed):
    noise = RNG(seed).normal(0.0, 1.0, (60, 3)) + RNG(seed + 100).normal(0.0, 1.0, 3)
    found = fitted(drive(), moved(TRUE, drive()) + noise, sigma=1.4)
    middle = drive().mean(axis=0)
    shift = np.linalg.norm((moved(found.T, middle) - moved(TRUE, middle))[:2])
    assert shift < 3 * found.shift_sigma
    assert pose_difference(found.T, TRUE)[1] < 3 * found.angle_sigma
    assert found.shift_sigma < 3.0
    assert found.angle_sigma < math.radians(10)


def test_moving_both_frames_changes_nothing():
    noise = RNG(1).normal(0.0, 0.5, (60, 3))
    enu = moved(TRUE, drive()) + noise
    before = fitted(drive(), enu)
    A, B = pose(-0.7, (5.0, 6.0, 1.0)), pose(1.9, (-200.0, 3.0, -4.0))
    after = fitted(moved(A, drive()), moved(B, enu))
    assert pose_difference(after.T, B @ before.T @ inverse(A)) == pytest.approx((0, 0), abs=1e-6)
    assert (after.shift_sigma, after.angle_sigma) == pytest.approx((before.shift_sigma, before.angle_sigma))


def test_outliers_are_left_out():
    enu = moved(TRUE, drive()) + RNG(2).normal(0.0, 0.2, (60, 3))
    enu[10:30] += (35.0, -20.0, 60.0)
    found = fitted(drive(), enu)
    shift, angle = pose_difference(found.T, TRUE)
    assert shift < 0.5
    assert math.degrees(angle) < 1.0
    assert found.shift_sigma < 0.4


def test_a_fix_at_the_other_end_of_the_world_changes_nothing():
    enu = moved(TRUE, drive())
    enu[:3] = (4e6, -3e6, 1e5)
    assert pose_difference(fitted(drive(), enu).T, TRUE) == pytest.approx((0, 0), abs=1e-3)


def test_accurate_fixes_count_more():
    sigmas = np.full((60, 2), 0.05)
    sigmas[::2] = 5.0
    enu = moved(TRUE, drive())
    enu[::2] += RNG(3).normal((3.0, 0.0, 4.0), 5.0, (30, 3))
    found = fit_fixes(drive(), enu, sigmas, np.arange(60.0))
    assert pose_difference(found.T, TRUE)[0] < 0.5


def test_a_short_way_gives_no_angle_and_no_pose():
    still = np.zeros((60, 3)) + RNG(4).normal(0.0, 0.01, (60, 3))
    noise = RNG(5).normal(0.0, 1.0, (60, 3))
    assert "a way of 0.1 m is too short for fixes that scatter by " in fitted(still, still + noise).refusal
    assert "is too short" in fitted(drive() / 10, moved(TRUE, drive() / 10) + 3 * noise).refusal
    assert "is too short" in fitted(np.ones((9, 3)), np.ones((9, 3))).refusal
    assert fitted(drive()[:4], drive()[:4]).refusal == "4 position fixes, fewer than 5"


def test_fixes_that_do_not_follow_the_poses_give_no_pose():
    assert "is too short" in fitted(drive(), RNG(6).normal(0.0, 15.0, (60, 3))).refusal


def test_frames_known_in_one_frame_are_related():
    one, other = (fitted(drive(), moved(T, drive()), sigma=0.5) for T in (TRUE, pose(0.3, (1.0, 2.0, 3.0))))
    related = other.relative_to(one)
    assert pose_difference(related.T, inverse(TRUE) @ pose(0.3, (1.0, 2.0, 3.0))) == pytest.approx((0, 0), abs=1e-6)
    assert related.shift_sigma == pytest.approx(0.5 * math.sqrt(2))


# --- tags ------------------------------------------------------------------------------------------------------------

TAGS = {"3": pose(0.4, (4.0, 1.0, 1.0), (1.2, 0.3)), "7": pose(-1.0, (9.0, -3.0, 1.5), (0.2, 1.4))}


def seen_from(T_team_map, tags=TAGS):
    return {name: inverse(T_team_map) @ T for name, T in tags.items()}


def sightings(T, n=40, seed=0, sigma=0.1):
    rng = RNG(seed)
    noise = [pose(*rng.normal(0.0, 0.05, 1), rng.normal(0.0, sigma, 3)) for _ in range(n)]
    return np.array([T @ error for error in noise])


def test_the_place_of_a_tag_is_the_mean_without_outliers():
    poses = sightings(TAGS["3"])
    poses[5] = pose(1.0, (4.0, 1.9, 1.0))
    poses[9] = pose(1.0, (400.0, 1.0, 1.0))
    shift, angle = pose_difference(tag_place(poses), TAGS["3"])
    assert shift < 0.06
    assert angle < 0.03
    assert pose_difference(tag_place(poses[:1]), poses[0]) == pytest.approx((0, 0), abs=1e-6)


def test_one_id_in_two_places_has_no_place():
    assert tag_place(np.concatenate([sightings(TAGS["3"]), sightings(TAGS["7"], seed=1)])) is None


@pytest.mark.parametrize("is_upright", [True, False])
@pytest.mark.parametrize("names", [("3",), ("3", "7")])
def test_common_tags_give_the_pose_between_two_robots(is_upright, names):
    A, B = pose(0.5, (1.0, 2.0, 0.0)), pose(-2.0, (-3.0, 8.0, 0.5))
    tags = {name: TAGS[name] for name in names}
    found = fit_tags(seen_from(A, tags), {**seen_from(B, tags), "99": np.eye(4)}, is_upright=is_upright)
    assert pose_difference(found.T, inverse(A) @ B) == pytest.approx((0, 0), abs=1e-6)
    assert found.names == names
    back = fit_tags(seen_from(B, tags), seen_from(A, tags), is_upright=is_upright)
    assert pose_difference(back.T, inverse(found.T)) == pytest.approx((0, 0), abs=1e-6)
    assert math.degrees(found.angle_sigma) < (6 if len(names) == 1 else 3)


def test_without_gravity_the_pose_has_a_tilt():
    A, B = pose(0.5, (1.0, 2.0, 0.0), (0.4, 0.2)), pose(-2.0, (-3.0, 8.0, 0.5))
    found = fit_tags(seen_from(A), seen_from(B), is_upright=False)
    assert pose_difference(found.T, inverse(A) @ B) == pytest.approx((0, 0), abs=1e-6)


def test_tags_that_disagree_are_left_out_or_refused():
    A, B = pose(0.5, (1.0, 2.0, 0.0)), pose(-2.0, (-3.0, 8.0, 0.5))
    third = {**TAGS, "9": pose(0.1, (0.0, 5.0, 1.0))}
    other = seen_from(B, third)
    other["7"] = pose(0.0, (50.0, 0.0, 0.0))
    found = fit_tags(seen_from(A, third), other, is_upright=True)
    assert found.names == ("3", "9")
    assert pose_difference(found.T, inverse(A) @ B) == pytest.approx((0, 0), abs=1e-6)
    two = fit_tags(seen_from(A), {name: other[name] for name in TAGS}, is_upright=True)
    assert two.refusal == "no two of the tags 3, 7 agree"


def test_robots_without_a_common_tag_are_not_related():
    assert fit_tags(seen_from(np.eye(4)), {"8": np.eye(4)}, is_upright=True) is None
    assert fit_tags({}, {}, is_upright=True) is None
