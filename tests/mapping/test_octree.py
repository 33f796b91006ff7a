from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.mapping.kernels import storage
from octoreplay.mapping.octree import SemanticOctree, codes_to_keys, keys_to_codes, octree_from_streams
from octoreplay.mapping.streams import leaf_list
from octoreplay.records import LeafTable
from reference.comparison import expand_leaves, num_lossless_leaves
from support.long_suite import examples
from support.octree_factory import cells_of, cube, octree_of

LIMIT = storage.KEY_OFFSET
RESOLUTION = 0.25


@st.composite
def cell_maps(draw, num_classes):
    """{key: values} of cubes with few distinct values, many of them aligned, so that many leaves can be merged."""
    values = st.sampled_from([-5.0, -0.25, 0.0, 1.0])
    cells = {}
    for _ in range(draw(st.integers(1, 4))):
        edge = draw(st.sampled_from([1, 2, 4, 8, 16]))
        corner = [edge * draw(st.integers(-3, 2)) + draw(st.sampled_from([0, 0, 0, 1])) for _ in range(3)]
        equal = draw(st.booleans())
        content = [draw(values)] * num_classes if equal else [draw(values) for _ in range(num_classes)]
        cells.update(cube(corner, edge, content))
    return cells


@examples(25)
@given(cells=cell_maps(num_classes=2))
def test_leaves_are_canonical_do_not_overlap_and_keep_the_volume(cells):
    octree = octree_of(cells)
    leaves = octree.leaves()
    keys, values = expand_leaves(leaves, RESOLUTION)
    content = dict(zip(map(tuple, keys.tolist()), values.tolist(), strict=True))
    assert len(content) == len(keys) == octree.num_cells == len(cells)
    assert content == {key: list(value) for key, value in cells.items()}
    assert (leaves.sizes**3).sum() == pytest.approx(len(cells) * RESOLUTION**3)
    # No eight sibling leaves are equal, so no lossless octree has fewer leaves.
    assert len(leaves) == num_lossless_leaves(keys, values.astype(np.float32))
    assert _in_morton_order(leaves)


@examples(25)
@given(cells=cell_maps(num_classes=2))
def test_spans_equal_the_leaves(cells):
    octree = octree_of(cells)
    spans = octree.spans()
    codes = np.concatenate([np.arange(code, code + n) for code, n in zip(spans.codes, spans.num_cells, strict=True)])
    assert (np.diff(codes) > 0).all()
    values = np.repeat(spans.deviations, spans.num_cells, axis=0)
    content = dict(zip(map(tuple, codes_to_keys(codes).tolist()), values.tolist(), strict=True))
    assert content == {key: list(value) for key, value in cells.items()}
    np.testing.assert_array_equal(keys_to_codes(codes_to_keys(codes)), codes)


def _in_morton_order(leaves):
    low = np.rint((leaves.centers - leaves.sizes[:, None] / 2) / RESOLUTION).astype(np.int64)
    codes = np.array([storage.key_to_code(*key) for key in low.tolist()])
    return bool((np.diff(codes) > 0).all())


@examples(40)
@given(cells=cell_maps(num_classes=3), seed=st.integers(0, 99))
def test_lookup_equals_the_leaves(cells, seed):
    octree = octree_of(cells, num_classes=3)
    rng = np.random.default_rng(seed)
    keys = np.concatenate([np.array(list(cells))[rng.integers(0, len(cells), 40)], rng.integers(-60, 60, (40, 3))])
    coords = (keys + rng.uniform(0.0, 1.0, keys.shape)) * RESOLUTION
    coords[::7] = keys[::7] * RESOLUTION  # the lowest corner of a cell belongs to the cell
    log_odds, known, sizes = octree.lookup(coords)
    leaves = octree.leaves()
    for coord, key, found, is_known, size in zip(coords, keys.tolist(), log_odds, known, sizes, strict=True):
        value = cells.get(tuple(key))
        assert is_known == (value is not None)
        assert found.tolist() == (list(value) if value is not None else [0.0, 0.0, 0.0])
        low = leaves.centers - leaves.sizes[:, None] / 2
        inside = np.flatnonzero(((low <= coord) & (coord < low + leaves.sizes[:, None])).all(axis=1))
        assert len(inside) == is_known
        assert size == (leaves.sizes[inside[0]] if is_known else 0.0)


def test_lookup_outside_the_key_space_is_unknown():
    octree = octree_of({(-LIMIT, 0, 0): [1.0, 2.0], (LIMIT - 1, 0, 0): [1.0, 2.0]})
    reach = LIMIT * RESOLUTION
    places = [[-reach, 0, 0], [np.nextafter(reach, 0), 0, 0], [reach, 0, 0], [-reach - 1, 0, 0], [1e300, 0, 0]]
    places += [[np.nan, 0, 0], [np.inf, 0, 0], [0, 0, -np.inf]]
    log_odds, known, sizes = octree.lookup(np.array(places))
    assert known.tolist() == [True, True] + 6 * [False]
    assert log_odds[:2].tolist() == [[1.0, 2.0]] * 2
    assert not log_odds[2:].any()
    assert (sizes > 0).tolist() == known.tolist()


def test_lookup_without_coordinates_and_in_an_empty_map():
    assert [len(part) for part in octree_of({(0, 0, 0): [1.0, 1.0]}).lookup(np.zeros((0, 3)))] == [0, 0, 0]
    log_odds, known, _ = SemanticOctree(0.2, 2).lookup(np.zeros((4, 3)))
    assert not known.any()
    assert log_odds.shape == (4, 2)


@examples(20)
@given(cells=cell_maps(num_classes=2), prior=st.sampled_from([0.0, 0.4, -0.7]))
def test_occupied_leaves_have_a_class_above_free(cells, prior):
    octree = octree_of(cells)
    everything, occupied = octree.leaves(prior), octree.leaves(prior, occupied_only=True)
    chosen = (everything.log_odds > 0).any(axis=1)
    np.testing.assert_array_equal(occupied.centers, everything.centers[chosen])
    np.testing.assert_array_equal(occupied.sizes, everything.sizes[chosen])
    np.testing.assert_array_equal(occupied.log_odds, everything.log_odds[chosen])


def test_the_prior_is_added_to_leaves():
    octree = octree_of({(0, 0, 0): [1.0, -0.25]})
    table = octree.leaves(prior=-1.5)
    assert isinstance(table, LeafTable)
    assert table.log_odds.tolist() == [[-0.5, -1.75]]
    assert table.centers.tolist() == [[0.125, 0.125, 0.125]]
    assert table.sizes.tolist() == [0.25]


@examples(40)
@given(seed=st.integers(0, 10_000), tolerance=st.sampled_from([0.0, 0.05, 0.2, 1.0, 10.0]))
def test_lossy_merging_stays_within_its_bound(seed, tolerance):
    """Cells differ from their merged leaf by at most half the tolerance, and no more leaves can be merged."""
    rng = np.random.default_rng(seed)
    corner = rng.integers(-9, 9, 3)
    cells = {}
    for key in cube(corner.tolist(), 8, None):
        if rng.random() < 0.97:
            cells[key] = (rng.integers(0, 3) + 0.1 * rng.random(2)).astype(np.float32)
    octree = octree_of(cells)
    merged = octree_from_streams(octree.streams(tolerance=tolerance), RESOLUTION, 2)
    after = cells_of(merged)
    assert after.keys() == cells.keys()
    for key, value in after.items():
        assert np.abs(np.frombuffer(value, np.float32) - cells[key]).max() <= tolerance / 2 * (1 + 1e-6) + 1e-7
    leaves = merged.leaves()
    finest = np.rint((leaves.centers - leaves.sizes[:, None] / 2) / RESOLUTION).astype(np.int64)
    groups = {}
    for key, size in zip(finest.tolist(), leaves.sizes, strict=True):
        if size == RESOLUTION:
            groups.setdefault(tuple(k >> 1 for k in key), []).append(cells[tuple(key)])
    for group in groups.values():
        assert len(group) < 8 or np.ptp(np.array(group), axis=0).max() > tolerance


def test_leaves_that_merge_to_equal_classes_are_not_vector_leaves():
    cells = cube((0, 0, 0), 2, [1.0, 0.0]) | {(1, 1, 1): [0.0, 1.0]}
    merged = octree_of(cells).streams(tolerance=1.0)
    assert (merged.values.tolist(), merged.masks.size) == ([0.5], 0)


@examples(40)
@given(cells=cell_maps(num_classes=2), prune=st.booleans())
def test_leaves_of_a_stream_do_not_overlap_and_cover_the_known_space(cells, prune):
    octree = octree_of(cells)
    codes, depths, _ = leaf_list(octree.streams(prune=prune))
    spans = np.int64(1) << (3 * (storage.KEY_BITS - depths.astype(np.int64)))
    assert (codes[1:] >= (codes + spans)[:-1]).all()
    assert (codes % spans == 0).all()
    assert spans.sum() == octree.num_cells
    assert prune or (depths == storage.KEY_BITS).all()


def test_without_pruning_every_known_cell_is_a_leaf():
    octree = octree_of(cube((0, 0, 0), 16, [-5.0, -5.0]) | {(40, 1, 1): [1.0, 0.0]})
    streams = octree.streams(prune=False)
    assert streams.num_leaves == octree.num_cells == 16**3 + 1
    assert cells_of(octree_from_streams(streams, RESOLUTION, 2)) == cells_of(octree)
    assert octree.streams().num_leaves == 2


def test_equal_siblings_are_not_merged_unless_all_are_known():
    cells = cube((0, 0, 0), 8, [-5.0, -5.0])
    del cells[7, 7, 7]
    octree = octree_of(cells)
    assert np.count_nonzero(octree.bricks.blocks[: octree.num_bricks] < 0) == 7
    assert len(octree.leaves()) == 7 + 7 + 7
    whole = octree_of(cube((0, 0, 0), 8, [-5.0, -5.0]))
    assert (whole.bricks.blocks[: whole.num_bricks] < 0).all()
    assert len(whole.leaves()) == 1


@examples(20)
@given(first=cell_maps(num_classes=2), second=cell_maps(num_classes=2))
def test_overwrite_replaces_whole_bricks(first, second):
    target, source = octree_of(first), octree_of(second)
    target.overwrite(source, np.arange(source.num_bricks), revision=5)
    bricks = {tuple(k >> storage.BRICK_BITS for k in key) for key in second}
    kept = {key: value for key, value in first.items() if tuple(k >> storage.BRICK_BITS for k in key) not in bricks}
    assert cells_of(target) == cells_of(octree_of(kept | second))
    assert np.count_nonzero(target.revisions == 5) == source.num_bricks


def test_a_copy_is_independent():
    octree = octree_of(cube((0, 0, 0), 3, [1.0, 2.0]))
    before = cells_of(octree)
    copy = octree.copy()
    copy.overwrite(octree_of(cube((0, 0, 0), 5, [0.0, 0.0])), np.arange(1))
    assert cells_of(octree) == before
    assert cells_of(copy) != before


def test_many_bricks_are_found_again():
    """The hash table and the arrays are enlarged many times."""
    rng = np.random.default_rng(0)
    octree = SemanticOctree(0.2, 1)
    codes = np.unique(rng.integers(0, 1 << 48, 30_000))
    rng.shuffle(codes)
    for part in np.array_split(codes, 37):
        indices = octree.find_or_add(part)
        assert (octree.codes[indices] == part).all()
    assert (octree.codes[octree.find(codes)] == codes).all()
    assert octree.num_bricks == len(codes)
    assert (octree.find(codes + (1 << 48)) == -1).all()
    assert octree.find_or_add(np.array([codes[3], codes[3]])).tolist() == [3, 3]
    assert octree.num_bricks == len(codes)


def test_morton_codes():
    keys = [(-LIMIT, -LIMIT, -LIMIT), (LIMIT - 1,) * 3, (0, 0, 0), (-1, 5, -77)]
    codes = np.array([storage.key_to_code(*key) for key in keys])
    assert codes[:2].tolist() == [0, (1 << 57) - 1]
    back = np.empty((4, 3), np.int64)
    storage.codes_to_keys(codes, back)
    assert [tuple(key) for key in back.tolist()] == keys
    for child in itertools.product((0, 1), repeat=3):
        x, y, z = child
        assert storage.key_to_code(2 + x, 4 + y, -6 + z) - storage.key_to_code(2, 4, -6) == x + 2 * y + 4 * z


def test_memory_bytes():
    octree = octree_of(cube((0, 0, 0), 8, [-5.0, -5.0]))
    assert octree.memory_bytes < 2000
    # One octet has a known cell: one shared row, and in the second map two class rows.
    free, hit = octree_of({(0, 0, 0): [1.0, 1.0]}), octree_of({(0, 0, 0): [1.0, 0.0]})
    one_value = octree_of(cube((0, 0, 0), 4, [1.0, 1.0]))
    rows = [(other.memory_bytes - one_value.memory_bytes) // storage.ROW_BYTES for other in (free, hit)]
    assert rows == [storage.block_rows(1), storage.block_rows(3)]


@pytest.mark.parametrize("needs_block", [True, False])
def test_block_grows_with_new_known_cells(needs_block):
    """Also without ``needs_block``, because the brick already has a block."""
    octree = octree_of({(3, 0, 0): [1.0, 2.0], (3, 3, 3): [0.5, 0.5]})
    before = cells_of(octree)
    masks = np.zeros((1, 1), np.uint64)
    has_new_cells = octree.expand_bricks(np.array([0]), masks, np.array([storage.ALL_CELLS]), np.array([needs_block]))
    assert has_new_cells.tolist() == [True]
    after = cells_of(octree)
    assert len(after) == storage.BRICK_CELLS
    assert {key: after[key] for key in before} == before
    assert {value for key, value in after.items() if key not in before} == {bytes(8)}
