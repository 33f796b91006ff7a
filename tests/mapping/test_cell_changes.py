"""Changes of one map that overwrite another one, against plain dictionaries of cells."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.mapping.cell_changes import take_changes
from octoreplay.mapping.codec import decode_packet, encode_packet
from support.long_suite import examples
from support.masses import changed_bricks, log_odds_octree, random_cells
from support.octree_factory import cells_of, cube

SEEDS = st.integers(0, 1_000_000)


def values_of(octree):
    return {key: np.frombuffer(values, np.float32) for key, values in cells_of(octree).items()}


def overwritten(cells, new, old):
    """Cells of a map after the changes between two states of another one."""
    changed = {key: new[key] for key in new if key not in old or (new[key] != old[key]).any()}
    return {**cells, **changed}


def later_state(rng, old):
    """State of a map some time later: some cells with other values in one class or in all, and some new cells."""
    new = dict(old)
    for key in old:
        if rng.random() < 0.3:
            new[key] = old[key] + np.float32(rng.choice([0.5, -1.0])) * (rng.random(3) < rng.choice([0.4, 1.0]))
    return {**new, **{key: value for key, value in random_cells(rng, of_log_odds=True).items() if key not in new}}


@examples(80)
@given(seed=SEEDS, is_decoded=st.booleans())
def test_changes_overwrite_the_cells_that_differ_and_no_others(seed, is_decoded):
    rng = np.random.default_rng(seed)
    old = random_cells(rng, of_log_odds=True)
    new = later_state(rng, old)
    target = {**{key: value + 1 for key, value in old.items()}, **random_cells(rng, of_log_odds=True)}
    octrees = [log_odds_octree(cells) for cells in (target, new, old)]
    if is_decoded:
        octrees[1:] = [decode_packet(encode_packet(octree)) for octree in octrees[1:]]
    octree = octrees[0]
    octree.revisions[:] = 1
    expected = overwritten(*map(values_of, octrees))
    take_changes(*octrees, octrees[1].codes.copy(), revision=7)
    found = values_of(octree)
    assert found.keys() == expected.keys()
    for key, values in expected.items():
        np.testing.assert_array_equal(found[key], values)
    fresh = set(octree.codes[octree.revisions == 7].tolist())
    assert changed_bricks(target, expected) <= fresh
    assert fresh <= {code for code in octree.codes.tolist() if code in set(octrees[1].codes.tolist())}


def test_equal_states_change_nothing():
    cells = cube((0, 0, 0), 4, np.float32([1, 2, 3]))
    target = log_odds_octree(cube((0, 0, 0), 4, np.float32([5, 5, 5])))
    state = log_odds_octree(cells)
    take_changes(target, state, log_odds_octree(cells), state.codes.copy(), revision=7)
    assert set(cells_of(target).values()) == {np.float32([5, 5, 5]).tobytes()}
    assert (target.revisions == 1).all()


def test_a_brick_of_one_value_is_pruned_again():
    target = log_odds_octree(cube((0, 0, 0), 4, np.float32([1, 1, 1])))
    new = log_odds_octree(cube((0, 0, 0), 4, np.float32([2, 2, 2])))
    take_changes(target, new, log_odds_octree({}), new.codes.copy(), revision=7)
    assert target.bricks.blocks[0] == -1
    assert target.bricks.values[0] == 2.0
