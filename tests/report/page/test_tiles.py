"""Tiles of maps against sets and dictionaries of cells."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.errors import OutputError
from octoreplay.mapping.octree import LeafSpans, codes_to_keys, keys_to_codes
from octoreplay.report.page.tile_pool import TilePool
from octoreplay.report.page.tile_store import NOTHING, TileStore, changes, most_tiles, update
from octoreplay.report.page.tiles import (
    PLAIN,
    TEAM_FIELDS,
    coarser,
    coarser_runs,
    cube_columns,
    free_runs,
    merged,
    occupied_cubes,
    runs_hold,
    split_runs,
    tile_places,
    tiles_of,
    union,
)
from support.long_suite import examples

Cells = dict[int, tuple[int, ...]]


def cubes_of(cells: Cells) -> np.ndarray:
    """Cubes of single cells with a label, a probability and the team's values."""
    cubes = np.zeros(len(cells), dtype=[*PLAIN, *TEAM_FIELDS])
    for row, code in enumerate(sorted(cells)):
        label, probability, seen, first = cells[code]
        cubes[row] = (code, 0, label, probability, 3 * probability, seen, first, label % 3)
    return cubes


def covered(cubes: np.ndarray) -> dict[int, tuple[int, ...]]:
    """Values of each cell that a cube covers; no cell is covered twice."""
    found: dict[int, tuple[int, ...]] = {}
    for cube in cubes:
        for code in range(cube["code"], cube["code"] + 8 ** int(cube["size"])):
            assert code not in found
            found[code] = tuple(int(cube[name]) for name in cubes.dtype.names if name not in ("code", "size"))
    return found


values = st.tuples(st.integers(0, 2), st.integers(0, 1), st.sampled_from([1, 2, 6]), st.sampled_from([0, 1, 3, 255]))
some_cells = st.dictionaries(st.integers(0, 130), values, max_size=100)
uniform_cells = st.builds(lambda codes: dict.fromkeys(codes, (1, 1, 2, 1)), st.sets(st.integers(0, 600), max_size=600))
full_blocks = st.builds(
    lambda blocks, rest: {**dict.fromkeys([8 * b + k for b in blocks for k in range(8)], (2, 0, 1, 1)), **rest},
    st.sets(st.integers(0, 70)), some_cells,
)  # fmt: skip


@examples(200)
@given(st.one_of(some_cells, uniform_cells, full_blocks))
def test_merging_keeps_the_values_of_all_cells(cells: Cells) -> None:
    cubes = merged(cubes_of(cells))
    assert covered(cubes) == covered(cubes_of(cells))
    assert (np.diff(cubes["code"]) > 0).all()
    assert (cubes["code"] % 8 ** cubes["size"].astype(np.int64) == 0).all()


def test_merging_fills_a_tile_and_no_more() -> None:
    cells = dict.fromkeys(range(2 * 8**5), (1, 1, 1, 1))
    cubes = merged(cubes_of(cells))
    assert cubes["size"].tolist() == [5, 5]


@examples(200)
@given(full_blocks)
def test_a_coarser_cell_has_the_most_frequent_class_and_the_largest_values(cells: Cells) -> None:
    groups: dict[int, list[tuple[int, ...]]] = {}
    for code, cell in covered(cubes_of(cells)).items():
        groups.setdefault(code >> 3, []).append(cell)
    found = covered(coarser(merged(cubes_of(cells))))
    assert found.keys() == groups.keys()
    for code, members in groups.items():
        label, probability, disagreement, seen, first, contradiction = found[code]
        counts = Counter(member[0] for member in members if member[0])
        assert label == (min(counts, key=lambda c: (-counts[c], c)) if counts else 0)
        assert probability == max(member[1] for member in members)
        assert disagreement == max(member[2] for member in members)
        assert seen == int(np.bitwise_or.reduce([member[3] for member in members]))
        assert first == min((member[4] for member in members if member[4]), default=0)
        assert contradiction == max(member[5] for member in members)


def runs_of(codes: set[int]) -> np.ndarray:
    """Runs of single cells, joined by the code under test."""
    return union([np.array([[code, 1]], dtype=np.int64) for code in sorted(codes)])


def cells_in(runs: np.ndarray) -> set[int]:
    """Cells of runs; no cell is in two runs."""
    cells = [code for start, length in runs.tolist() for code in range(start, start + length)]
    assert len(cells) == len(set(cells))
    return set(cells)


code_sets = st.one_of(
    st.sets(st.integers(0, 300)),
    st.builds(lambda a, n: set(range(a, a + n)), st.integers(0, 99_000), st.integers(0, 99)),
)


@examples(200)
@given(code_sets, code_sets)
def test_runs_are_sets_of_cells(first: set[int], second: set[int]) -> None:
    both = union([runs_of(first), runs_of(second)])
    assert cells_in(both) == first | second
    assert cells_in(coarser_runs(both)) == {code >> 3 for code in first | second}
    asked = np.arange(400)
    assert runs_hold(both, asked).tolist() == [code in first | second for code in asked.tolist()]


@examples(100)
@given(st.lists(st.tuples(st.integers(0, 99), st.integers(1, 90_000)), max_size=5))
def test_split_runs_end_at_the_borders_of_tiles(parts: list[tuple[int, int]]) -> None:
    starts, place = [], 0
    for gap, length in parts:
        starts.append((place + gap, length))
        place += gap + length + 1
    runs = np.array(starts, dtype=np.int64).reshape(-1, 2)
    pieces = split_runs(runs)
    assert pieces[:, 1].sum() == runs[:, 1].sum()
    assert ((pieces[:, 0] >> 15) == ((pieces.sum(axis=1) - 1) >> 15)).all()
    assert np.array_equal(union([pieces]), union([runs]))


def test_leaves_larger_than_a_tile_are_cut() -> None:
    spans = LeafSpans(np.array([0, 8**7]), np.array([8**6, 1]), np.zeros((2, 1), np.float32))
    cubes = occupied_cubes(spans, np.array([1, 1], np.uint8), np.full((2, 1), 2.0, np.float32))
    assert cubes["size"].tolist() == [5] * 8 + [0]
    assert cubes["code"].tolist() == [k * 8**5 for k in range(8)] + [8**7]


def test_free_space_of_leaves() -> None:
    spans = LeafSpans(np.array([0, 8, 16, 64]), np.array([8, 8, 8, 64]), np.zeros((4, 1), np.float32))
    assert free_runs(spans, np.array([True, True, False, True])).tolist() == [[0, 16], [64, 64]]


@given(st.lists(st.tuples(*[st.integers(-(2**18), 2**18 - 1)] * 3), min_size=1, max_size=20), st.integers(0, 13))
def test_places_of_tiles(keys: list[tuple[int, int, int]], level: int) -> None:
    array = np.array(keys, dtype=np.int64)
    codes = keys_to_codes(array) >> (15 + 3 * level)
    places = tile_places(codes, np.full(len(codes), level, np.uint8))
    np.testing.assert_array_equal(places, array >> (5 + level))
    np.testing.assert_array_equal(codes_to_keys(keys_to_codes(array)), array)


def test_equal_contents_are_stored_once() -> None:
    with TilePool({"a": "<u2", "b": "u1"}) as pool:
        first = pool.add({"a": np.array([1, 2]), "b": np.array([3, 4])})
        second = pool.add({"a": np.array([1]), "b": np.array([3])})
        assert pool.add({"a": np.array([1, 2]), "b": np.array([3, 4])}) == first
        assert first != second
        assert len(pool) == 2
        columns = pool.columns([second, first])
        assert columns["starts"].tolist() == [0, 1, 3]
        assert columns["a"].tolist() == [1, 1, 2]
        assert columns["b"].tolist() == [3, 3, 4]
        pool.replace("b", np.array([0, 0, 0, 8, 9]))
        assert pool.column("b", [first]).tolist() == [8, 9]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device without space")
def test_a_full_disk_is_an_error_of_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.TemporaryFile", lambda: Path("/dev/full").open("w+b"))  # noqa: SIM115 - the pool closes it.
    with TilePool({"a": "<u2"}) as pool:
        first = pool.add({"a": np.arange(9)})
        with pytest.raises(OutputError, match="No space left"):
            pool.column("a", [first])
        with pytest.raises(OutputError, match="No space left"):
            pool.add({"a": np.arange(99_999)})
    monkeypatch.setattr("tempfile.TemporaryFile", mock.Mock(side_effect=OSError(30, "Read-only file system")))
    with pytest.raises(OutputError, match="Read-only"):
        TilePool({"a": "<u2"})


def test_columns_of_a_tile_hold_steps_of_codes() -> None:
    cubes = cubes_of({8**5 + 3: (1, 2, 1, 1), 8**5 + 9: (2, 5, 1, 1), 2 * 8**5 + 1: (1, 1, 1, 1)})
    tiles = list(tiles_of(cubes["code"]))
    assert [tile for tile, _ in tiles] == [1, 2]
    assert cube_columns(cubes[tiles[0][1]])["steps"].tolist() == [3, 6]


@pytest.mark.parametrize("empty", [np.zeros(0, dtype=[*PLAIN, *TEAM_FIELDS])])
def test_no_cubes(empty: np.ndarray) -> None:
    assert len(merged(empty)) == len(coarser(empty)) == 0
    assert list(tiles_of(empty["code"])) == []


@examples(60)
@given(st.lists(st.tuples(st.one_of(some_cells, full_blocks), code_sets), min_size=1, max_size=4), st.booleans())
def test_coarser_tiles_are_those_of_the_coarser_map(ticks: list[tuple[Cells, set[int]]], is_spread: bool) -> None:
    with TileStore() as store:
        rows = []
        latest: dict = {}
        maps = []
        for index, (cells, free) in enumerate(ticks):
            # Cells of several tiles, or of one.
            spread = {code * 4096: cell for code, cell in cells.items()} if is_spread else cells
            cubes, runs = cubes_of(spread), runs_of({code * 999 for code in free})
            maps.append((merged(cubes), runs))
            present = store.put(*maps[-1])
            gone = dict.fromkeys(latest.keys() - present.keys(), NOTHING)
            changed = {tile: new for tile, new in {**present, **gone}.items() if latest.get(tile) != new}
            update(latest, changed)
            rows.extend((index, tile, *changed[tile]) for tile in sorted(changed))
        table = np.array(rows, np.int64).reshape(-1, 5)
        found = dict(changes(store.coarser_rows(table)))
        coarse: dict = {}
        largest = 0
        for index, (cubes, runs) in enumerate(maps):
            update(coarse, found.get(index, {}))
            assert coarse == store.put(coarser(cubes), coarser_runs(runs))
            largest = max(largest, len(store.put(cubes, runs)))
        assert most_tiles(table) == largest
