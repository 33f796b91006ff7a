"""OctoMap files, read back node by node."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.io.results.octomap_trees import tree_file
from octoreplay.records import LeafTable
from support.long_suite import examples
from support.octomap_reader import read_octomap

RESOLUTION = 0.25


@st.composite
def maps(draw: st.DrawFn) -> dict[tuple[int, int, int, int], tuple[list[float], tuple[int, int, int]]]:
    """Leaves that do not overlap: log-odds of two classes and colours by lowest key and edge in cells."""
    cells = st.tuples(*[st.integers(-4, 3)] * 3)
    found = {}
    taken: set[tuple[int, int, int]] = set()
    for cell in draw(st.lists(cells, min_size=1, max_size=12, unique=True)):
        edge = draw(st.sampled_from([1, 2, 4]))
        key = tuple(value // edge * edge for value in cell)
        inside = {tuple(np.add(key, step)) for step in np.ndindex(edge, edge, edge)}
        if taken.isdisjoint(inside):
            taken |= inside
            numbers = draw(st.lists(st.floats(-5, 5, width=32), min_size=2, max_size=2))
            found[*key, edge] = numbers, draw(st.tuples(*[st.integers(0, 255)] * 3))
    return found


def table_of(leaves) -> tuple[LeafTable, np.ndarray]:
    """Leaf table and colours."""
    keys = np.array([place[:3] for place in leaves])
    edges = np.array([place[3] for place in leaves])
    log_odds = np.array([numbers for numbers, _ in leaves.values()], np.float32)
    colors = np.array([color for _, color in leaves.values()], np.uint8)
    return LeafTable((keys + edges[:, None] / 2) * RESOLUTION, edges * RESOLUTION, log_odds), colors


@examples(200)
@given(leaves=maps())
def test_trees_hold_every_leaf(tmp_path_factory: pytest.TempPathFactory, leaves) -> None:
    folder = tmp_path_factory.mktemp("octomap")
    table, colors = table_of(leaves)
    occupancy = np.log(np.exp(table.log_odds.astype(np.float64)).sum(axis=1))
    for name in ("map.bt", "map.ot"):
        (folder / name).write_bytes(tree_file(table, colors, RESOLUTION, binary=name == "map.bt"))
        header, read = read_octomap(folder / name)
        assert header["size"] == header["nodes read"]
        assert (header["res"], read.keys()) == ("0.25", leaves.keys())
        for value, (_, color), expected in zip(map(read.get, leaves), leaves.values(), occupancy, strict=True):
            if name == "map.bt":
                assert header["id"] == "OcTree"
                assert value == (expected >= 0,) or abs(expected) < 1e-6
            else:
                assert header["id"] == "ColorOcTree"
                assert value[0] == pytest.approx(expected, abs=1e-5)
                assert value[1:] == color


def test_the_first_lines_are_those_of_octomap(tmp_path: Path) -> None:
    table, colors = table_of({(0, 0, 0, 1): ([1.0, 0.0], (1, 2, 3))})
    for name, line in (("m.bt", "# Octomap OcTree binary file"), ("m.ot", "# Octomap OcTree file")):
        (tmp_path / name).write_bytes(tree_file(table, colors, RESOLUTION, binary=name == "m.bt"))
        assert read_octomap(tmp_path / name)[0]["first line"] == line


def test_maps_beyond_the_keys_of_octomap_are_refused(tmp_path: Path) -> None:
    for key in (1 << 15, -(1 << 15) - 1):
        table, colors = table_of({(key, 0, 0, 1): ([1.0, 0.0], (1, 2, 3))})
        with pytest.raises(ValueError, match="the map reaches further than 8192 m from the origin"):
            tree_file(table, colors, RESOLUTION, binary=False)


@pytest.mark.parametrize("kind", ["bt", "ot"])
def test_octomap_reads_the_same_occupancy_and_colours(tmp_path: Path, kind: str) -> None:
    pyoctomap = pytest.importorskip("pyoctomap", exc_type=ImportError)
    random = np.random.default_rng(3)
    places = {(*map(int, key), 1): (value, color) for key, value, color in zip(
        random.integers(-9, 9, (60, 3)), random.uniform(-3, 3, (60, 2)).tolist(),
        [tuple(row) for row in random.integers(0, 255, (60, 3)).tolist()], strict=True,
    )}  # fmt: skip
    # A leaf of eight cells, which OctoMap keeps as one.
    places[16, 16, 16, 2] = [1.0, 0.0], (9, 8, 7)
    table, colors = table_of(places)
    path = tmp_path / f"map.{kind}"
    path.write_bytes(tree_file(table, colors, RESOLUTION, binary=kind == "bt"))
    if kind == "bt":
        tree = pyoctomap.OcTree(RESOLUTION)
        assert tree.readBinary(str(path))
    else:
        tree = pyoctomap.ColorOcTree(RESOLUTION).read(str(path))
    assert tree.getNumLeafNodes() == len(table)
    assert tree.getResolution() == RESOLUTION
    occupancy = np.log(np.exp(table.log_odds.astype(np.float64)).sum(axis=1))
    for center, color, expected in zip(table.centers, colors, occupancy, strict=True):
        node = tree.search(center)
        assert tree.isNodeOccupied(node) == (expected >= 0)
        if kind == "ot":
            assert node.getLogOdds() == pytest.approx(expected, abs=1e-5)
            assert tuple(node.getColor()) == tuple(color.tolist())
    assert tree.search(np.array([30.0, 0.0, 0.0])) is None
