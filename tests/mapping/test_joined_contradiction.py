"""Contradiction of evidence in tiles: as that of the whole."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.config.sensor import SensorConfig
from octoreplay.mapping.contradiction import EvidenceComparer, state_limits
from octoreplay.mapping.joined_contradiction import JoinedEvidence
from octoreplay.mapping.octree import SemanticOctree
from support.long_suite import examples
from support.octree_factory import octree_of

LIMITS = state_limits(SensorConfig())
NUM_CELLS = 8
"""Edge of the tiles [cells], two bricks: every brick is at a side."""
GROUND, TREE, FREE, FIRMLY_FREE = [2.0, -1.0], [-0.6, 1.0], [-0.3, -0.3], [-1.5, -1.6]
IDS = ("first", "second", "third")


class Tiles:
    """Comparison of the whole evidence, and in tiles; ``cells`` are the robots' cells so far."""

    def __init__(self, num_cells, num_robots=3):
        self.cells = [{} for _ in range(num_robots)]
        self._num_cells = num_cells
        self._ids = IDS[:num_robots]
        self._whole = self._comparer()
        self._octrees = self._new_octrees()
        self._tiles = {}
        self._joined = JoinedEvidence(self._ids, 2)
        self._tick = 0

    def _comparer(self, **options):
        return EvidenceComparer(self._ids, 2, LIMITS, **options)

    def _new_octrees(self):
        return [SemanticOctree(0.25, 2) for _ in self._ids]

    def forget(self):
        """Begin the first robot's evidence anew."""
        self.cells[0] = {}
        for comparer, octrees in [(self._whole, self._octrees), *self._tiles.values()]:
            comparer.forget()
            octrees[0] = SemanticOctree(0.25, 2)

    def pairs(self, changes):
        """Pairs of the whole and of the tiles after changes of each robot's cells."""
        self._tick += 1
        for robot, changed in enumerate(changes):
            self.cells[robot].update(changed)
            touched = {tuple(int(k) // 4 for k in key) for key in changed}
            bricks = {key: v for key, v in self.cells[robot].items() if tuple(int(k) // 4 for k in key) in touched}
            self._write(self._octrees[robot], bricks)
            for tile in {(key[0] // self._num_cells, key[1] // self._num_cells) for key in bricks}:
                _, octrees = self._tiles.setdefault(
                    tile, (self._comparer(tile_cells=self._num_cells), self._new_octrees())
                )
                inside = {k: v for k, v in bricks.items() if (k[0] // self._num_cells, k[1] // self._num_cells) == tile}
                self._write(octrees[robot], inside)
        whole = self._whole.compare(self._octrees, self._tick)
        parts = []
        for comparer, octrees in self._tiles.values():
            comparer.compare(octrees, self._tick)
            parts.append(comparer.part())
        return whole, self._joined.joined(parts)

    def _write(self, octree, cells):
        if cells:
            changed = octree_of(cells)
            octree.overwrite(changed, np.arange(changed.num_bricks), self._tick)


@pytest.mark.parametrize("beside", [(8, 0, 0), (8, 8, 1), (6, 0, 0), (7, 1, 1), (9, 0, 0)])
def test_an_occupied_cell_in_the_next_tile_is_beside_a_free_one(beside):
    tiles = Tiles(NUM_CELLS, 2)
    whole, joined = tiles.pairs([{(7, 0, 0): GROUND}, {(7, 0, 0): FIRMLY_FREE, (8, 0, 5): FREE}])
    assert joined == whole
    assert whole[0].clear_contradiction == 1.0
    whole, joined = tiles.pairs([{}, {beside: TREE}])
    assert joined == whole
    assert whole[0].clear_contradiction == float(beside in ((8, 8, 1), (9, 0, 0)))
    whole, joined = tiles.pairs([{}, {beside: FREE}])
    assert joined == whole
    assert whole[0].clear_contradiction == 1.0


keys = st.tuples(*[st.integers(-10, 10)] * 3)
values = st.sampled_from([GROUND, TREE, FREE, FIRMLY_FREE])
ticks = st.lists(st.tuples(*[st.dictionaries(keys, values, max_size=40)] * 3), min_size=1, max_size=4)


@examples(40)
@given(ticks, st.sampled_from([8, 16]), st.integers(0, 4))
def test_random_evidence_in_tiles_as_the_whole(changes, num_cells, restart):
    tiles = Tiles(num_cells)
    # All tiles exist from the beginning, as in a run.
    corners = {(x, y, 0): FREE for x in (-10, -1, 1, 9) for y in (-10, -1, 1, 9)}
    whole, joined = tiles.pairs([corners] * 3)
    assert joined == whole
    for number, change in enumerate(changes):
        if number == restart:
            tiles.forget()
        whole, joined = tiles.pairs(change)
        assert repr(joined) == repr(whole)
