"""Labels corrected and made wrong by an exchange, counted by hand and cell by cell."""

from pathlib import Path

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.evaluate.repairs import Repairs, erased_cells, repairs
from octoreplay.evaluate.truth import Truth
from octoreplay.mapping.octree import keys_to_codes
from octoreplay.stored_map import StoredMap
from support import octree_factory
from support.long_suite import examples

FREE, GROUND, TREE = [-2.0, -2.0], [2.0, -1.0], [-1.0, 2.0]
VALUES = {0: FREE, 1: GROUND, 2: TREE}


def stored(labels: dict[tuple[int, int, int], int]) -> StoredMap:
    """A map with these cells and labels."""
    octree = octree_factory.octree_of({key: VALUES[label] for key, label in labels.items()}, resolution=1.0)
    return StoredMap(octree, "alpha", 1, 0, 0.0, 2)


def truth_of(labels: dict[tuple[int, int, int], int]) -> Truth:
    """A truth with these surface cells; 0 is a class that the maps do not have."""
    codes = keys_to_codes(np.array(list(labels), np.int64).reshape(-1, 3))
    order = np.argsort(codes)
    return Truth(Path("world.npz"), codes[order], np.array(list(labels.values()), np.uint8)[order])


def test_each_kind_of_change_by_hand() -> None:
    own = {
        (0, 0, 0): 1,
        (1, 0, 0): 2,
        (2, 0, 0): 0,
        (3, 0, 0): 2,
        (4, 0, 0): 1,
        (5, 0, 0): 0,
        (6, 0, 0): 1,
        (7, 0, 0): 0,
    }
    after = {
        (7, 0, 0): 1,
        (0, 0, 0): 1,
        (1, 0, 0): 1,
        (2, 0, 0): 2,
        (3, 0, 0): 0,
        (4, 0, 0): 2,
        (6, 0, 0): 2,
        (9, 0, 0): 1,
    }
    # By x: right in both; corrected (1, 2); false surface corrected (3); made wrong (4); free in all (5); without a
    # class (6); false surface made (7).
    surface = {(0, 0, 0): 1, (1, 0, 0): 1, (2, 0, 0): 2, (4, 0, 0): 1, (6, 0, 0): 0, (9, 0, 0): 1}
    assert repairs(stored(own), stored(after), truth_of(surface)) == Repairs(5, 3, 3, 2)


def test_a_cell_that_is_unknown_after_the_exchange_has_the_label_of_the_prior() -> None:
    own, surface = {(0, 0, 0): 1, (1, 0, 0): 1}, {(0, 0, 0): 1, (7, 7, 7): 2}
    # The prior's label is free, which is right for the cell without surface and wrong for the other one.
    assert repairs(stored(own), stored({(5, 5, 5): 0}), truth_of(surface)) == Repairs(2, 1, 1, 1)


KEYS = st.tuples(*[st.integers(-3, 4)] * 3)


@examples(60)
@given(
    own=st.dictionaries(KEYS, st.integers(0, 2), min_size=1, max_size=40),
    after=st.dictionaries(KEYS, st.integers(0, 2), min_size=1, max_size=40),
    surface=st.dictionaries(KEYS, st.integers(0, 2), min_size=1, max_size=40),
)
def test_counts_equal_those_over_cells(own, after, surface) -> None:
    counts = num_wrong = num_repaired = num_spread = 0
    for key, label in own.items():
        if surface.get(key) == 0:
            continue
        was_right, is_right = label == surface.get(key, 0), after.get(key, 0) == surface.get(key, 0)
        counts += key in surface or label > 0
        num_wrong += not was_right
        num_repaired += not was_right and is_right
        num_spread += was_right and not is_right
    expected = Repairs(counts, num_wrong, num_repaired, num_spread)
    assert repairs(stored(own), stored(after), truth_of(surface)) == expected


@examples(60)
@given(
    own=st.dictionaries(KEYS, st.integers(0, 2), min_size=1, max_size=40),
    after=st.dictionaries(KEYS, st.integers(0, 2), min_size=1, max_size=40),
)
def test_erased_cells_equal_those_over_cells(own, after) -> None:
    occupied = [key for key, label in own.items() if label > 0]
    # A cell that is unknown after the exchange has the label of the prior, free.
    num_erased = sum(after.get(key, 0) == 0 for key in occupied)
    assert erased_cells(stored(own), stored(after)) == (len(occupied), num_erased)
