from __future__ import annotations

import itertools

import numpy as np
import pytest

from octoreplay.records import LeafTable
from reference.comparison import compare_map, expand_leaves, num_lossless_leaves
from reference.hand_made import ray, team_config
from reference.twin import Twin, record


def _leaves(centers, sizes, log_odds):
    return LeafTable(np.array(centers, float), np.array(sizes, float), np.array(log_odds, np.float32))


def _local_run():
    config = team_config("a", rule="local", settle=0)
    recording = record(config, [ray("a", 0.0, 1)])
    return recording.keys, list(Twin(config, recording).ticks())[-1]


GOOD = ([[0.5, 0.5, 0.5], [1.5, 0.5, 0.5], [2.5, 0.5, 0.5]], [1, 1, 1], [[-0.3, -0.3], [-0.3, -0.3], [1, -0.3]])


def test_equal_maps_do_not_differ():
    keys, tick = _local_run()
    result = compare_map(keys, tick, 0, _leaves(*GOOD), 1.0)
    assert result.max_abs < 1e-7
    assert (result.missing, result.spurious, result.overlapping) == (0, 0, 0)


def test_wrong_value_is_reported_with_its_key():
    keys, tick = _local_run()
    centers, sizes, log_odds = GOOD
    wrong = [log_odds[0], [-0.3, 0.2], log_odds[2]]
    result = compare_map(keys, tick, 0, _leaves(centers, sizes, wrong), 1.0)
    assert result.max_abs == pytest.approx(0.5)
    assert result.worst_key == (1, 0, 0)


def test_missing_spurious_and_overlapping_cells_are_counted():
    keys, tick = _local_run()
    # One leaf of 2 m over cells 0..1 (and seven untouched cells), a second one over cell 0, none at 2.
    leaves = _leaves([[1.0, 1.0, 1.0], [0.5, 0.5, 0.5]], [2, 1], [[-0.3, -0.3], [-0.3, -0.3]])
    result = compare_map(keys, tick, 0, leaves, 1.0)
    assert (result.missing, result.spurious, result.overlapping) == (1, 6, 1)
    assert result.max_abs == pytest.approx(1.0)


def test_all_cells_are_missing_without_leaves():
    keys, tick = _local_run()
    empty = _leaves(np.zeros((0, 3)), [], np.zeros((0, 2)))
    result = compare_map(keys, tick, 0, empty, 1.0)
    assert (result.missing, result.spurious) == (3, 0)


def test_expanded_leaves_cover_their_cubes():
    keys, log_odds = expand_leaves(_leaves([[-0.5, 0.5, 0.5], [0.125, 0.125, 0.125]], [1.0, 0.25], [[1], [2]]), 0.25)
    assert len(keys) == 64 + 1
    cube = set(itertools.product(range(-4, 0), range(4), range(4)))
    assert {tuple(key) for key, value in zip(keys.tolist(), log_odds[:, 0], strict=True) if value == 1} == cube


def test_leaf_sizes_must_be_whole_cells():
    with pytest.raises(AssertionError, match="whole number"):
        expand_leaves(_leaves([[0, 0, 0]], [0.3], [[1]]), 0.25)


def test_lossless_leaves_by_hand():
    cube = np.array(list(itertools.product(range(-4, 0), repeat=3)))
    values = np.ones((64, 2))
    assert num_lossless_leaves(cube, values) == 1
    assert num_lossless_leaves(cube, values, max_levels=1) == 8
    values[0, 1] = 2.0
    assert num_lossless_leaves(cube, values) == 7 + 8
    # Seven of eight siblings are seven leaves; eight equal cells that are no siblings are eight leaves.
    assert num_lossless_leaves(cube[1:], np.ones((63, 2))) == 7 + 7
    assert num_lossless_leaves(np.array(list(itertools.product((1, 2), repeat=3))), np.ones((8, 2))) == 8
