"""Sizes of streams that are counted where octrees change, compared with those of whole streams."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.mapping.kernels import storage
from octoreplay.mapping.octree import SemanticOctree, codes_to_keys
from octoreplay.mapping.stream_size import StreamMeter, joined_size, joined_unpruned_size
from octoreplay.mapping.streams import StreamSize
from support.long_suite import examples, long
from support.octree_factory import cube, octree_of
from support.packet_format import octrees


@examples(60)
@given(octree=octrees())
def test_the_size_is_that_of_the_whole_stream(octree):
    assert StreamMeter(octree).update(0) == octree.streams().size


@long
@examples(60)
@given(maps=st.lists(octrees(num_classes=3), min_size=2, max_size=4))
def test_changes_are_counted_where_they_are(maps):
    octree = SemanticOctree(maps[0].resolution, 3)
    meter = StreamMeter(octree)
    for revision, change in enumerate(maps, start=1):
        octree.overwrite(change, np.arange(change.num_bricks), revision)
        assert meter.update(revision) == octree.streams().size


def uniform(side, value, num_classes=2):
    """Octree of a cube of ``side`` x ``side`` x ``side`` bricks of one value."""
    octree = SemanticOctree(0.25, num_classes)
    bricks = np.stack(np.meshgrid(*[np.arange(side)] * 3), axis=-1).reshape(-1, 3)
    codes = np.empty(len(bricks), np.int64)
    storage.keys_to_codes(bricks * storage.BRICK_EDGE, codes)
    octree.find_or_add(codes >> storage.CELL_BITS)
    octree.known[:], octree.bricks.values[: octree.num_bricks] = storage.ALL_CELLS, value
    octree.revisions[:] = 1
    return octree


@pytest.mark.parametrize("side", [4, 8, 16])
def test_leaves_above_the_chunks_are_merged(side):
    octree = uniform(side, -2.0)
    meter = StreamMeter(octree)
    assert meter.update(0) == octree.streams().size
    assert meter.update(0).num_leaves == 1
    # One other cell divides the leaf; the next change restores it.
    other, same = octree_of(cube((3, 3, 3), 1, (1.0, 0.0))), uniform(1, -2.0)
    octree.overwrite(other, np.arange(1), 2)
    assert meter.update(2) == octree.streams().size
    octree.overwrite(same, np.arange(1), 3)
    assert meter.update(3) == octree.streams().size
    assert meter.update(4).num_leaves == 1


def test_the_part_is_that_of_the_last_change():
    octree = uniform(16, -2.0)
    meter = StreamMeter(octree)
    meter.update(0)
    before = meter.part(64)
    octree.overwrite(octree_of(cube((3, 3, 3), 1, (1.0, 0.0))), np.arange(1), 2)
    meter.update(2)
    after, fresh = meter.part(64), StreamMeter(octree)
    fresh.update(0)
    assert after.size != before.size
    for cells in (64, 32, 64):
        assert meter.part(cells).size == fresh.part(cells).size
        assert meter.part(cells).num_levels == fresh.part(cells).num_levels


def test_equal_leaves_with_several_values_are_merged_above_the_chunks():
    octree = octree_of(cube((0, 0, 0), 32, (1.0, -2.0)))
    size = StreamMeter(octree).update(0)
    assert size == octree.streams().size
    assert (size.num_leaves, size.num_vectors) == (1, 1)


def test_eight_different_leaves_stay():
    octree = uniform(8, 1.0)
    octree.bricks.values[octree.find(np.array([0]))[0]] = 1.5
    octree.bricks.values[: octree.num_bricks][octree.codes >= 448] = 2.0
    assert StreamMeter(octree).update(0) == octree.streams().size


def test_an_empty_octree_has_no_stream():
    octree = SemanticOctree(0.25, 2)
    assert StreamMeter(octree).update(0) == octree.streams().size == StreamSize()


def test_unchanged_chunks_are_not_counted_again():
    octree = uniform(8, 1.0)
    meter = StreamMeter(octree)
    before = meter.update(0)
    # A change without a new revision stays unseen.
    octree.bricks.values[:1] = 3.0
    assert meter.update(2) == before


def tiles_of(octree, num_cells):
    """Parts of an octree in columns with an edge of ``num_cells``, and the sizes of their streams without pruning."""
    keys = codes_to_keys(octree.codes * storage.BRICK_CELLS)[:, :2] // num_cells
    for tile in np.unique(keys, axis=0):
        part = SemanticOctree(octree.resolution, octree.num_classes)
        part.overwrite(octree, np.flatnonzero((keys == tile).all(axis=1)), 1)
        yield part


def check_joined(octree, num_cells):
    parts, unpruned = [], []
    for tile in tiles_of(octree, num_cells):
        meter = StreamMeter(tile)
        meter.update(0)
        parts.append(meter.part(num_cells))
        unpruned.append(tile.streams(prune=False).size)
    assert joined_size(parts) == octree.streams().size
    assert joined_unpruned_size(unpruned, parts) == octree.streams(prune=False).size


@examples(60)
@given(octree=octrees(), num_cells=st.sampled_from([16, 32, 128]))
def test_sizes_of_tiles_are_joined(octree, num_cells):
    if octree.num_bricks:
        check_joined(octree, num_cells)


@pytest.mark.parametrize("num_cells", [16, 32, 64])
def test_leaves_above_the_tiles_are_merged(num_cells):
    octree = uniform(32, -2.0)
    check_joined(octree, num_cells)
    parts = []
    for tile in tiles_of(octree, num_cells):
        meter = StreamMeter(tile)
        meter.update(0)
        parts.append(meter.part(num_cells))
    assert joined_size(parts).num_leaves == 1
    octree.bricks.values[octree.find(np.array([octree.codes.max()]))[0]] = 1.5
    check_joined(octree, num_cells)


def test_an_empty_tile_has_no_size():
    empty, octree = SemanticOctree(0.25, 2), uniform(8, 1.0)
    meters = [StreamMeter(empty), StreamMeter(octree)]
    for meter in meters:
        meter.update(0)
    parts = [meter.part(32) for meter in meters]
    assert joined_size(parts[:1]) == StreamSize()
    assert joined_size(parts) == octree.streams().size
