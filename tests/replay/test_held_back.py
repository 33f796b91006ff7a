"""Test of corrected poses on scans that were held back."""

from __future__ import annotations

import numpy as np
import pytest

from octoreplay.replay.held_back import Contradiction, HeldBack, is_held_back, judge

CELLS = 20_000.0


def held_back(shares: dict[tuple[tuple[int, int], tuple[int, int]], float], *, num_robots: int = 3) -> HeldBack:
    """Comparison of one part for each robot; ``shares`` are contradictions of (is corrected, robot) with another."""
    shape = (2, num_robots, 2, num_robots)
    cells, contradicting = np.full(shape, CELLS), np.full(shape, 0.5 * CELLS)
    for (a, b), share in shares.items():
        contradicting[(*a, *b)] = contradicting[(*b, *a)] = share * CELLS
    return HeldBack(np.arange(num_robots), cells, contradicting, np.full((2, num_robots), 2.0))


BETTER = {((1, i), (1, j)): 0.3 for i in range(3) for j in range(i)}


def test_a_group_that_contradicts_itself_less_is_corrected() -> None:
    scores = judge(held_back(BETTER), [(0, 1, 2)])
    assert [score.is_accepted for score in scores] == [True, True, True]
    assert scores[0].before == Contradiction(40_000, 20_000)
    assert scores[0].after == Contradiction(40_000, 12_000)


@pytest.mark.parametrize("share", [0.49, 0.5, 0.7])
def test_a_group_without_a_clear_gain_keeps_its_poses(share: float) -> None:
    scores = judge(held_back(dict.fromkeys(BETTER, share)), [(0, 1, 2)])
    assert not any(score.is_accepted for score in scores)
    assert all("contradiction" in score.reason for score in scores)


def test_a_robot_that_gets_worse_keeps_its_poses_and_the_others_are_corrected() -> None:
    worse = {((1, 2), (variant, robot)): 0.6 for variant in (0, 1) for robot in (0, 1)}
    scores = judge(held_back({((1, 0), (1, 1)): 0.3, **worse}), [(0, 1, 2)])
    assert [score.is_accepted for score in scores] == [True, True, False]
    assert scores[2].reason == "its own contradiction does not fall"


def test_a_robot_with_a_blurred_map_keeps_its_poses() -> None:
    compared = held_back(BETTER)
    compared.entropy_bits[1, 1] = 2.2
    scores = judge(compared, [(0, 1, 2)])
    assert [score.is_accepted for score in scores] == [True, False, True]
    assert scores[1].reason == "its entropy grows"


def test_a_robot_without_registrations_keeps_its_poses() -> None:
    scores = judge(held_back(BETTER), [(0, 1)])
    assert [score.is_accepted for score in scores] == [True, True, False]
    assert scores[2].reason == "no other submap overlaps its own"


def test_few_cells_decide_nothing() -> None:
    compared = held_back(BETTER)
    few = HeldBack(compared.robots, compared.cells / 1000, compared.contradicting / 1000, compared.entropy_bits)
    assert not any(score.is_accepted for score in judge(few, [(0, 1, 2)]))


def test_parts_of_one_robot_are_compared_with_each_other() -> None:
    cells = np.full((2, 2, 2, 2), CELLS)
    contradicting = 0.5 * cells
    contradicting[1, :, 1, :] = 0.2 * CELLS
    scores = judge(HeldBack(np.array([0, 0]), cells, contradicting, np.ones((2, 1))), [(0,)])
    assert scores[0].before == Contradiction(20_000, 10_000)
    assert scores[0].after == Contradiction(20_000, 4_000)
    assert scores[0].is_accepted


def test_every_nth_scan_is_held_back() -> None:
    assert [number for number in range(12) if is_held_back(number, 5)] == [4, 9]
