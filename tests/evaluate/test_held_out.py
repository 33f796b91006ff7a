"""Prediction of what a robot measured by the others' evidence, against a cell-by-cell twin."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.evaluate.held_out import prediction
from octoreplay.mapping.contradiction import StateLimits
from support import octree_factory

LIMITS = StateLimits(np.float32(0.5), np.float32(-0.3), np.float32(-1.5))


def octrees(robots):
    """One octree of each robot's cells."""
    return [octree_factory.octree_of(cells, resolution=1.0) for cells in robots]


def naive(evidence, prior, measured):
    """Numbers of a prediction without the temperature, cell by cell."""
    losses, sums, both, union = [], {}, 0, 0
    for robot, own in enumerate(measured):
        others = evidence[:robot] + evidence[robot + 1 :]
        for key, values in own.items():
            if max(values) >= 0.5:
                state = 1 + int(np.argmax(values))
            elif max(values) <= -1.5:
                state = 0
            else:
                continue
            if not any(key in other for other in others):
                continue
            total = prior + sum((np.array(other[key]) for other in others if key in other), np.zeros(2))
            chances = np.exp([0.0, *total]) / np.exp([0.0, *total]).sum()
            label = int(np.argmax(chances))
            losses.append(-np.log(chances[state]))
            correct, expected = sums.get(int(np.ceil(chances[label] * 15)), (0, 0.0))
            sums[int(np.ceil(chances[label] * 15))] = correct + (label == state), expected + chances[label]
            both += label > 0 and state > 0
            union += label > 0 or state > 0
    error = sum(abs(correct - expected) for correct, expected in sums.values())
    count = len(losses)
    return (count, both / union, error / count, float(np.mean(losses))) if union else None


cell = st.tuples(st.integers(0, 2), st.integers(0, 2), st.integers(0, 1))
values = st.lists(st.sampled_from([-3.0, -1.5, -0.3, 0.25, 0.5, 2.0]), min_size=2, max_size=2)
maps = st.lists(st.dictionaries(cell, values, min_size=1, max_size=8), min_size=2, max_size=3)


@given(maps, st.sampled_from([0.0, -0.75]), st.sampled_from([1.0, 1.25]))
def test_it_equals_the_twin(measured, prior, factor) -> None:
    evidence = [{key: [factor * value for value in row] for key, row in robot.items()} for robot in measured]
    expected = naive(evidence, prior, measured)
    arguments = octrees(evidence), prior, octrees(measured), LIMITS
    occupied = {
        (robot, key) for robot, own in enumerate(measured) for key, row in own.items()
        if max(row) >= 0.5 and any(key in other for n, other in enumerate(measured) if n != robot)
    }  # fmt: skip
    if not occupied:
        assert prediction(*arguments) is None
        return
    found = prediction(*arguments)
    assert found.num_cells == expected[0]
    assert found[1:4] == pytest.approx(expected[1:], abs=1e-6)


def test_certain_evidence_predicts_equal_evidence() -> None:
    robot = {(0, 0, 0): [5.0, -5.0], (1, 0, 0): [-5.0, -5.0], (2, 0, 0): [0.0, 0.0]}
    found = prediction(octrees([robot, robot]), 0.0, octrees([robot, robot]), LIMITS)
    assert (found.num_cells, found.iou) == (4, 1.0)
    assert found.log_loss < 0.02
    assert found.temperature < 0.1
