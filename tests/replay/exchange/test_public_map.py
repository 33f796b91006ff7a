"""Public maps: rounding as in packets, largest changes first, new revisions for changed bricks only."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from octoreplay.config.robot import RobotConfig
from octoreplay.config.run import RunConfig
from octoreplay.mapping import codec
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.mapping.quantise import quantised, top_classes
from octoreplay.records import ClassTable, SemanticClass
from octoreplay.replay.exchange.messages import HeldMap, Source
from octoreplay.replay.exchange.packet_codec import PacketCodec
from octoreplay.replay.exchange.public_map import PublicMap
from support.long_suite import long, one_in
from support.octree_factory import cells_of, octree_of

SOURCE = Source(0, 0)
CLASSES = ClassTable((SemanticClass(1, "wall", (1,), ()), SemanticClass(2, "ground", (2,), ())))


def _public_map(**parameters):
    config = RunConfig(robots=(RobotConfig("a", (Path("a.mcap"),)),), classes=CLASSES)
    config = config.with_parameters({"resolution": 0.25, **parameters})
    encoder = PacketCodec(config.packet)
    return PublicMap(config, encoder, SOURCE), encoder


def _random_cells(random, num_bricks, *, scale=1.0):
    """Cells of a row of bricks, each brick with values of its own size."""
    cells = {}
    for brick in range(num_bricks):
        size = scale * 10.0 ** random.uniform(-1.5, 0.5)
        for x, y, z in random.integers(0, 4, (int(random.integers(2, 30)), 3)).tolist():
            cells[4 * brick + x, y, z] = random.normal(size=2) * size
    return cells


def _changed_since(held, base):
    """The bricks (x of their lowest cell) that a delta from ``base`` holds."""
    chosen = np.flatnonzero(held.octree.revisions >= base)
    part = SemanticOctree(held.octree.resolution, held.octree.num_classes)
    part.overwrite(held.octree, chosen)
    return sorted({key[0] // 4 for key in cells_of(part)})


# --- exact ------------------------------------------------------------------------------------------------------------


def test_an_exact_public_map_is_a_copy_that_keeps_its_versions():
    public, _ = _public_map()
    assert public.is_exact
    octree = octree_of({(0, 0, 0): [1.0, 2.0], (4, 0, 0): [-0.3, 0.7]})
    held = public.advance(octree, 0, 7)
    assert held.version == 7
    assert cells_of(held.octree) == cells_of(octree)
    assert held.octree.revisions.tolist() == [6, 6]
    assert octree.revisions.tolist() == [1, 1]
    before = cells_of(held.octree)
    octree.overwrite(octree_of({(0, 0, 0): [9.0, 9.0], (0, 8, 0): [1.0, 1.0]}), np.arange(2), 7)
    assert cells_of(held.octree) == before
    new = public.advance(octree, 7, 8)
    assert cells_of(new.octree) == cells_of(octree)
    assert sorted(new.octree.revisions.tolist()) == [6, 7, 7]
    assert cells_of(held.octree) == before
    assert held.octree.revisions.tolist()[:2] == [6, 6]


@pytest.mark.parametrize(
    "parameters",
    [{"content": "int8"}, {"content": "float16"}, {"top_classes": 1}, {"prune_tolerance": 0.1},
     {"packets": "delta", "budget": 4096}],
    ids=str,
)  # fmt: skip
def test_an_inexact_public_map_is_marked(parameters):
    assert not _public_map(**parameters)[0].is_exact


@pytest.mark.parametrize("parameters", [{}, {"content": "int8"}], ids=str)
def test_a_map_that_did_not_change_is_published_without_a_copy(parameters):
    public, _ = _public_map(**parameters)
    octree = octree_of({(0, 0, 0): [1.0, 2.0], (4, 0, 0): [-0.3, 0.7]})
    first = public.advance(octree, 0, 7)
    second = public.advance(octree, 7, 8)
    assert second.octree is first.octree
    assert second.version == 8
    octree.overwrite(octree_of({(0, 0, 0): [9.0, 9.0]}), np.arange(1), 8)
    third = public.advance(octree, 8, 9)
    assert third.octree is not first.octree


# --- rounded ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("parameters", "rounded"),
    [
        ({"content": "int8", "int8_step": 0.5}, lambda octree: quantised(octree, "int8", 0.5)),
        ({"content": "float16"}, lambda octree: quantised(octree, "float16", 0.5)),
        ({"top_classes": 1}, lambda octree: top_classes(octree, 1)),
    ],
    ids=["int8", "float16", "top_classes"],
)
def test_only_bricks_that_changed_after_rounding_get_a_revision(parameters, rounded, seed):
    random = np.random.default_rng(seed)
    public, _ = _public_map(**parameters)
    cells = _random_cells(random, 12)
    before = None
    num_kept = 0
    for version in range(5, 12):
        octree = octree_of(cells)
        held = public.advance(octree, 0, version)
        expected = cells_of(rounded(octree))
        assert cells_of(held.octree) == expected
        assert held.version == version
        assert (held.octree.revisions < version).all()
        if before is not None:
            keys = {key for key in expected if expected[key] != before.get(key)}
            assert _changed_since(held, version - 1) == sorted({key[0] // 4 for key in keys})
            num_kept += 12 - len({key[0] // 4 for key in keys})
        before = expected
        # Some bricks change much, some by less than is sent, and one gets a cell without evidence.
        for key in list(cells):
            if key[0] // 4 % 3 == version % 3:
                cells[key] = cells[key] + random.normal(size=2)
            else:
                cells[key] = cells[key] + (1e-5 if "int8_step" in parameters else 0.0)
        cells[4 * (version % 12), 3, 3] = np.zeros(2)
    assert num_kept > 20


def test_pruning_merges_close_values_only():
    public, _ = _public_map(prune_tolerance=0.1)
    close = {(x, y, z): [1.0 + 0.01 * (x + y + z), -1.0] for x in range(2) for y in range(2) for z in range(2)}
    far = {(4 + x, y, z): [1.0 + 0.2 * x, -1.0] for x in range(2) for y in range(2) for z in range(2)}
    octree = octree_of({**close, **far})
    shown = cells_of(public.advance(octree, 0, 3).octree)
    assert len({shown[key] for key in close}) == 1
    assert {key: shown[key] for key in far} == {key: cells_of(octree)[key] for key in far}


def test_published_versions_do_not_change():
    random = np.random.default_rng(0)
    public, _ = _public_map(content="int8")
    versions = []
    for version in range(1, 6):
        octree = octree_of(_random_cells(random, 5))
        held = public.advance(octree, 0, version)
        versions.append((held, cells_of(held.octree)))
    assert all(cells_of(held.octree) == cells for held, cells in versions)
    assert len({str(cells) for _, cells in versions}) == 5


# --- the budget -------------------------------------------------------------------------------------------------------


def _distances(target, shown):
    """Brute force: by brick, the squared differences of all classes and cells, and the bricks with new cells."""
    target, shown = cells_of(target), cells_of(shown) if shown is not None else {}
    distances, is_new = {}, set()
    for key, values in target.items():
        brick = key[0] // 4
        there = np.frombuffer(shown[key], np.float32) if key in shown else np.zeros(2)
        difference = np.frombuffer(values, np.float32).astype(np.float64) - there
        distances[brick] = distances.get(brick, 0.0) + float((difference**2).sum())
        if key not in shown:
            is_new.add(brick)
    return distances, is_new


def _by_brick(octree):
    """{brick: its cells}, of octrees whose bricks are in a row."""
    content = {}
    for key, values in cells_of(octree).items():
        content.setdefault(key[0] // 4, {})[key] = values
    return content


BUDGETS = (
    {"budget": 1300}, {"budget": 1250, "packet_compression": "none"}, {"budget": 450, "content": "int8"},
    {"budget": 1300, "prune_tolerance": 1e-9},
)  # fmt: skip


@long
@pytest.mark.parametrize(("parameters", "seed"), one_in(5, BUDGETS, range(2)), ids=str)
def test_within_a_budget_the_largest_changes_go_first(parameters, seed):
    random = np.random.default_rng(seed)
    public, encoder = _public_map(packets="delta", **parameters)
    cells = _random_cells(random, 36)
    octree = octree_of(cells)
    target = quantised(octree, parameters.get("content", "float32"), 0.05)
    octree.revisions[:] = 0
    before, num_versions = None, 0
    for version in range(1, 25):
        if version == 3:
            # In the middle of it the map changes.
            changes = _random_cells(random, 10, scale=0.5)
            cells.update(changes)
            octree = octree_of(cells)
            changed = octree.find(octree_of(changes).codes)
            octree.revisions[:] = 0
            octree.revisions[changed] = version - 1
            target = quantised(octree, parameters.get("content", "float32"), 0.05)
        distances, is_new = _distances(target, before)
        waiting = [brick for brick in distances if distances[brick] > 0 or brick in is_new]
        held = public.advance(octree, version - 1, version)
        sent = _changed_since(held, version - 1)
        packet = encoder.packet(SOURCE, held, version - 1)
        assert len(packet) <= parameters["budget"]
        assert codec.read_header(packet).kind == codec.DELTA
        # The bricks that are up to date are those that change most; equal ones in any order.
        assert set(sent) <= set(waiting)
        least = min((distances[brick] for brick in sent), default=np.inf)
        rest = [distances[brick] for brick in waiting if brick not in sent]
        assert max(rest, default=0.0) <= least * (1 + 1e-6)
        assert not waiting or sent
        if rest:
            assert len(packet) > 0.5 * parameters["budget"]
            num_versions += 1
        shown, expected = _by_brick(held.octree), _by_brick(target)
        old = {} if before is None else _by_brick(before)
        for brick in expected:
            assert shown.get(brick) == (expected[brick] if brick in sent else old.get(brick))
        before = held.octree
    assert num_versions >= 2
    assert cells_of(held.octree) == cells_of(target)
    assert len(_changed_since(held, 24)) == 0


def test_the_budget_is_shared_with_the_maps_of_others():
    octree = octree_of(_random_cells(np.random.default_rng(0), 40))
    sizes = []
    for num_shares in (1, 2, 4):
        public, encoder = _public_map(packets="delta", budget=8192)
        held = public.advance(octree, 0, 1, num_shares=num_shares)
        sizes.append(len(encoder.packet(SOURCE, held, 0)))
        assert sizes[-1] <= 8192 // num_shares
    assert sizes[0] > sizes[1] > sizes[2] > 500


def test_cells_without_evidence_are_published():
    public, _ = _public_map(packets="delta", budget=1024)
    octree = octree_of({(0, 0, 0): [0.0, 0.0], (4, 1, 0): [2.0, 0.0]})
    held = public.advance(octree, 0, 1)
    assert cells_of(held.octree) == cells_of(octree)
    octree = octree_of({(0, 0, 0): [0.0, 0.0], (4, 1, 0): [2.0, 0.0], (4, 2, 0): [0.0, 0.0]})
    held = public.advance(octree, 0, 2)
    assert cells_of(held.octree) == cells_of(octree)
    assert _changed_since(held, 1) == [1]


def test_an_empty_map_is_published():
    public, encoder = _public_map(packets="delta", budget=1024)
    nothing = SemanticOctree(0.25, 2)
    held = public.advance(nothing, 0, 1)
    assert held.octree.num_bricks == 0
    assert isinstance(held, HeldMap)
    assert codec.read_header(encoder.packet(SOURCE, held, 0)).num_leaves == 0
