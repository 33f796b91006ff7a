"""Snapshots of octrees, compared with copies that were taken at the same time."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.mapping.octree import SemanticOctree
from octoreplay.mapping.snapshot import Snapshot
from support.long_suite import examples, long
from support.octree_factory import cells_of, octree_of
from support.packet_format import octrees


def _content(octree):
    """Cells, and the revisions of bricks with known cells."""
    is_known = octree.known != 0
    revisions = dict(zip(octree.codes[is_known].tolist(), octree.revisions[is_known].tolist(), strict=True))
    return cells_of(octree), revisions


@long
@examples(30)
@given(maps=st.lists(octrees(num_classes=3), min_size=2, max_size=6))
def test_a_snapshot_keeps_the_content_of_its_time(maps):
    octree = SemanticOctree(maps[0].resolution, 3)
    snapshots, copies = [], []
    for revision, change in enumerate(maps, start=1):
        for snapshot in snapshots:
            snapshot.save(change.codes)
        octree.overwrite(change, np.arange(change.num_bricks), revision)
        snapshots.append(Snapshot(octree))
        copies.append(octree.copy())
        if revision == len(maps) // 2:
            # Reading in between changes nothing.
            assert _content(snapshots[0].octree) == _content(copies[0])
    for snapshot, copy in zip(snapshots, copies, strict=True):
        assert _content(snapshot.octree) == _content(copy)


def test_a_snapshot_of_an_unchanged_octree_is_the_octree():
    octree = octree_of({(0, 0, 0): [1.0, 2.0]})
    snapshot = Snapshot(octree)
    assert snapshot.octree is octree
    snapshot.save(np.empty(0, np.int64))
    assert snapshot.octree is octree


def test_only_bricks_that_change_are_saved_and_once():
    octree = octree_of({(0, 0, 0): [1.0, 2.0], (4, 0, 0): [3.0, 4.0]})
    snapshot, first = Snapshot(octree), octree.codes[:1]
    snapshot.save(first)
    octree.overwrite(octree_of({(0, 0, 0): [9.0, 9.0]}), np.arange(1), 5)
    snapshot.save(first)
    assert cells_of(snapshot.saved) == cells_of(octree_of({(0, 0, 0): [1.0, 2.0]}))
    assert snapshot.saved.revisions.tolist() == [1]


def test_new_bricks_are_saved_without_cells():
    octree = octree_of({(0, 0, 0): [1.0, 2.0]})
    new = octree_of({(4, 0, 0): [3.0, 4.0]})
    snapshot = Snapshot(octree)
    snapshot.save(new.codes)
    octree.overwrite(new, np.arange(1), 5)
    assert snapshot.saved.codes.tolist() == new.codes.tolist()
    assert snapshot.saved.num_cells == 0
    assert cells_of(snapshot.octree) == cells_of(octree_of({(0, 0, 0): [1.0, 2.0]}))
