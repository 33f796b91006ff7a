"""Sums over rows that are added up where rows changed, compared with sums over all rows."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.mapping.block_sums import BLOCK_ROWS, BlockSums
from support.long_suite import examples


@examples(40)
@given(
    seed=st.integers(0, 1000),
    changes=st.lists(st.tuples(st.integers(1, 2000), st.floats(0, 1)), min_size=1, max_size=5),
)
def test_the_sum_is_that_of_all_rows(seed, changes):
    rng = np.random.default_rng(seed)
    sums = BlockSums(3, np.int32, np.int64)
    num_rows = 0
    for more, share in changes:
        num_rows += more
        sums.reserve(num_rows)
        changed = np.flatnonzero(rng.random(num_rows) < share)
        sums.rows[changed] = rng.integers(0, 2**31 - 1, (changed.size, 3))
        sums.update(changed)
        assert sums.total().tolist() == sums.rows.sum(axis=0, dtype=np.int64).tolist()


def test_rows_without_an_update_keep_their_sum():
    sums = BlockSums(1, np.float64, np.float64)
    sums.reserve(2 * BLOCK_ROWS)
    sums.rows[:] = 1.0
    sums.update(np.array([3]))
    assert sums.total() == [BLOCK_ROWS]


@pytest.mark.parametrize("order", [(0, 300), (300, 0)])
def test_the_sum_does_not_depend_on_the_order_of_updates(order):
    sums = BlockSums(1, np.float64, np.float64)
    sums.reserve(512)
    for row in order:
        sums.rows[row] = 1e16 if row == 0 else 1.0
        sums.update(np.array([row]))
    sums.rows[0] = 0.0
    sums.update(np.array([0]))
    assert sums.total() == [1.0]


def test_nothing_has_the_sum_0():
    sums = BlockSums(2, np.int32, np.int64)
    sums.update(np.empty(0, np.int64))
    assert sums.total().tolist() == [0, 0]
