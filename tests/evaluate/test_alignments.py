"""Outcomes of alignments against true frames, from maps of a village."""

from __future__ import annotations

import dataclasses
import functools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.evaluate.alignments import PairOutcome, pair_outcomes
from octoreplay.replay.alignment import Alignment, align_robots
from octoreplay.transforms import numbers_of
from support.long_suite import examples
from support.village_maps import T_village_map, empty_map, team_config, village_map

PLACES = {"a": ((0.0, 0.0), 0), "b": ((4.0, 2.0), 1)}


@functools.cache
def aligned() -> Alignment:
    """Alignment of two robots whose maps overlap, and of one without a known cell."""
    maps = [village_map(center, 13.0, turns=turns) for center, turns in PLACES.values()]
    return align_robots(team_config("a", "b", "c"), [*maps, empty_map()])


def true_frames(**moved: np.ndarray) -> dict[str, tuple[float, ...]]:
    """True frames of the robots, some of them moved."""
    frames = {robot_id: T_village_map(center, turns=turns) for robot_id, (center, turns) in PLACES.items()}
    frames["c"] = np.eye(4)
    return {robot_id: numbers_of(T @ moved.get(robot_id, np.eye(4))) for robot_id, T in frames.items()}


def test_a_found_pair_is_right_and_a_map_without_cells_is_refused() -> None:
    found, *others = pair_outcomes(aligned(), true_frames())
    assert found.is_accepted
    assert found.is_right
    assert found.shift < 0.1
    assert found.angle < 0.5
    assert 0.1 < found.overlap < 1.0
    assert [(other.is_accepted, other.is_right, other.overlap) for other in others] == [(False, False, 0.0)] * 2


@examples(60)
@given(
    shift=st.tuples(*[st.floats(-4.0, 4.0)] * 2),
    yaw=st.floats(-180.0, 180.0),
)
def test_errors_are_those_of_the_true_frame(shift: tuple[float, float], yaw: float) -> None:
    alignment = aligned()
    exact = dataclasses.replace(
        alignment.pairs[0],
        T_first_second=np.linalg.inv(T_village_map(PLACES["a"][0])) @ T_village_map(PLACES["b"][0], turns=1),
    )
    moved, angle = np.eye(4), math.radians(yaw)
    moved[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    moved[:2, 3] = shift
    exact_alignment = dataclasses.replace(alignment, pairs=(exact,))
    (outcome,) = pair_outcomes(exact_alignment, true_frames(b=moved))
    assert outcome.angle == pytest.approx(abs(yaw), abs=1e-3)
    # Obstacle by obstacle, over those that have an obstacle of the first map beside them under the "true" pose.
    first, second = alignment.maps[:2]
    T_true = exact.T_first_second @ moved
    errors, shared = [], []
    for point in second.obstacles.points:
        true = T_true[:3, :3] @ point + T_true[:3, 3]
        errors.append(np.linalg.norm(exact.T_first_second[:3, :3] @ point + exact.T_first_second[:3, 3] - true))
        shared.append(bool(first.at(true[None])[1][0]))
    chosen = np.array(errors)[shared] if sum(shared) >= 20 else np.array(errors)
    assert outcome.shift == pytest.approx(chosen.mean(), abs=1e-6)


@pytest.mark.parametrize(
    ("shift", "angle", "is_right"), [(0.99, 4.99, True), (1.0, 0.0, False), (0.0, 5.0, False), (math.inf, 0.0, False)]
)
def test_a_pose_is_right_up_to_the_limits(shift: float, angle: float, is_right: bool) -> None:
    assert PairOutcome(0.5, True, shift, angle).is_right == is_right


def test_maps_that_are_placed_in_their_robots_frames_have_the_same_outcome() -> None:
    alignment, turned = aligned(), T_village_map((1.0, -2.0), turns=3)
    placed = dataclasses.replace(alignment, T_map_own=tuple(turned for _ in alignment.maps))
    frames = true_frames(**dict.fromkeys(("a", "b", "c"), np.linalg.inv(turned)))
    for one, other in zip(pair_outcomes(placed, frames), pair_outcomes(alignment, true_frames()), strict=True):
        assert one.shift == pytest.approx(other.shift, abs=1e-6)
        assert one[:2] == pytest.approx(other[:2])
