"""Exports of a part of a map: a box, tiles, and coarser cells."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData

from octoreplay.errors import ConfigError, InputError
from octoreplay.io.results.result_writer import ResultWriter
from octoreplay.log_odds import best_labels
from octoreplay.mapping.codec import encode_packet
from octoreplay.mapping.contradiction import CellContradiction
from octoreplay.report.cell_colors import COLORS, CONTRADICTION_COLORS, leaf_colors
from octoreplay.report.export import export_map
from octoreplay.report.map_part import MapPart
from octoreplay.result import open_result
from support.long_suite import long
from support.octomap_reader import read_octomap
from support.octree_factory import cube, octree_of
from support.result_factory import state, write_result

BOUNDS = (-5.9, -7.0, 0.2, 5.1, 9.14, 2.2)


@pytest.fixture
def walls(tmp_path: Path) -> Path:
    """Result of one wall of equal cells of 0.2 m from x = -1.6 to 4.8 m, one tree cell, and free cells before it."""
    cells = {**cube((-8, 0, 0), 8, [2.0, -1.0]), **cube((0, 0, 0), 8, [2.0, -1.0]), **cube((8, 0, 0), 16, [2.0, -1.0])}
    cells |= {**cube((-8, -8, 0), 8, [-2.0, -2.0]), (-8, -8, 0): [-1.0, 3.0]}
    data = encode_packet(octree_of(cells, resolution=0.2))

    def fill(writer: ResultWriter) -> None:
        for robot_id in ("alpha", "beta"):
            writer.write_state(state(robot_id, 0, 1, data, key=True))

    return write_result(tmp_path, fill)


def table(path: Path) -> dict[tuple[float, ...], tuple[int, ...]]:
    """Colours of the points of a PLY file by place and size."""
    vertices = PlyData.read(path)["vertex"]
    places = np.column_stack([vertices[name] for name in ("x", "y", "z", "size")]).astype(np.float64).round(4)
    colors = np.column_stack([vertices[name] for name in ("red", "green", "blue")])
    return dict(zip(map(tuple, places.tolist()), map(tuple, colors.tolist()), strict=True))


@pytest.mark.parametrize("split", [None, "class", pytest.param("robot", marks=long)])
def test_tiles_are_the_exports_of_their_boxes(walls: Path, tmp_path: Path, split: str | None) -> None:
    whole = export_map(walls, tmp_path / "map.ply", free=True, split=split)
    tiles = export_map(walls, tmp_path / "tile.ply", free=True, split=split, tile=1.5)
    for path in whole:
        name = path.stem.replace("map", "tile")
        own = [tile for tile in tiles if tile.stem.startswith(f"{name}-x")]
        assert len(own) > 1 or split == "class"
        for tile in own:
            x, y = (float(number) for number in tile.stem.removeprefix(f"{name}-x").split("_y"))
            box = tmp_path / f"box-{tile.stem}.ply"
            exported = export_map(
                walls, box, free=True, bounds=(x, y, -9.0, x + 1.5, y + 1.5, 9.0),
                robot=name.split("-")[1] if split == "robot" else None,
            )  # fmt: skip
            if split == "class":
                assert table(tile).items() <= table(box).items()
            else:
                assert table(tile) == table(box)
                assert tiles[tile] == exported[box]
        volumes = [sum(size**3 for *_, size in table(part)) for part in (path, *own)]
        assert volumes[0] == pytest.approx(sum(volumes[1:]))


def test_tiles_are_named_by_their_lower_limits(walls: Path, tmp_path: Path) -> None:
    files = export_map(walls, tmp_path / "map.ply", tile=1.6)
    names = ["map-x-1.6_y-1.6", "map-x-1.6_y0", "map-x0_y0", "map-x1.6_y0", "map-x3.2_y0", "map-x1.6_y1.6",
             "map-x3.2_y1.6"]  # fmt: skip
    assert [path.stem for path in files] == names
    assert not (tmp_path / "map.ply").exists()
    # 0.7 * 3 is 2.0999999999999996.
    assert "map-x2.1_y0.ply" in {path.name for path in export_map(walls, tmp_path / "map.ply", tile=0.7)}


@pytest.mark.parametrize("suffix", [".npz", ".glb", ".las", ".bt", ".ot", ".yaml"])
def test_every_format_has_tiles(walls: Path, tmp_path: Path, suffix: str) -> None:
    files = export_map(walls, tmp_path / f"map{suffix}", tile=3.2)
    assert all(path.exists() for path in files)
    stems = {"map-x-3.2_y-3.2", "map-x-3.2_y0", "map-x0_y0", "map-x3.2_y0"}
    assert {path.stem for path in files} == stems
    assert len(files) == len(stems) * (2 if suffix == ".yaml" else 1)


def test_tiles_of_heights_have_the_colours_of_the_whole_map(pair_result: Path, tmp_path: Path) -> None:
    whole = table(next(iter(export_map(pair_result, tmp_path / "map.ply", color="height"))))
    found: dict[tuple[float, ...], tuple[int, ...]] = {}
    for tile in export_map(pair_result, tmp_path / "tile.ply", color="height", tile=6.0):
        found |= table(tile)
    common = whole.keys() & found.keys()
    assert len(common) > 0.9 * len(whole)
    assert all(whole[key] == found[key] for key in common)


def test_trees_of_a_depth_have_its_cells(walls: Path, tmp_path: Path) -> None:
    path = tmp_path / "map.bt"
    export_map(walls, path, max_depth=18)
    header, leaves = read_octomap(path)
    assert float(header["res"]) == 0.4
    occupied = sum(edge**3 for (*_, edge), (value,) in leaves.items() if value)
    # The walls, and the coarse cell of the tree; its other seven cells are free.
    assert occupied == (8**3 + 8**3 + 16**3) // 8 + 1
    assert sum(edge**3 for *_, edge in leaves) == (8**3 + 8**3 + 16**3 + 8**3) // 8


def test_a_coarse_leaf_is_occupied_if_a_cell_is(walls: Path, tmp_path: Path) -> None:
    path = tmp_path / "map.npz"
    export_map(walls, path, max_depth=16, free=True)
    with np.load(path) as archive:
        assert archive["resolution"] == pytest.approx(1.6)
        labels = {
            tuple(np.round(center - size / 2, 4).tolist()): (int(label), round(float(size), 4))
            for center, size, label in zip(archive["centers"], archive["sizes"], archive["labels"], strict=True)
        }
    # The tree cell is the only occupied one of its 512.
    assert labels[(-1.6, -1.6, 0.0)] == (2, 1.6)
    assert labels[(-1.6, 0.0, 0.0)] == (1, 1.6)
    assert labels[(0.0, 0.0, 0.0)] == (1, 1.6)
    assert labels[(1.6, 0.0, 0.0)] == (1, 1.6)


@pytest.mark.parametrize("color", [color for color in COLORS if color not in ("height", "disagreement")])
@pytest.mark.parametrize("max_depth", [None, 18])
def test_a_box_has_the_colours_of_the_whole_map(pair_result: Path, color: str, max_depth: int | None) -> None:
    with open_result(pair_result) as result:
        found = {}
        for name, bounds in (("whole", ()), ("box", BOUNDS)):
            part = MapPart(None, bounds, max_depth)
            stored = part.map(result, "husky_1")
            leaves = stored.leaves()
            # Coarse cells that the box cuts differ.
            edge = stored.resolution
            inside = (
                (leaves.centers - leaves.sizes[:, None] / 2 > np.add(BOUNDS[:3], edge))
                & (leaves.centers + leaves.sizes[:, None] / 2 < np.subtract(BOUNDS[3:], edge))
            ).all(axis=1)  # fmt: skip
            colors = leaf_colors(result, [stored], leaves, color, part).colors[inside]
            kept = leaves.taken(inside)
            keys = [tuple(row) for row in np.column_stack([kept.centers, kept.sizes]).round(4).tolist()]
            found[name] = dict(zip(keys, map(tuple, colors.tolist()), strict=True))
        common = found["whole"].keys() & found["box"].keys()
        assert len(common) >= 0.9 * len(found["whole"])
        assert all(found["whole"][key] == found["box"][key] for key in common)


@pytest.mark.parametrize("max_depth", [None, 17])
def test_cells_at_a_side_of_the_box_have_the_contradiction_of_the_whole_map(
    tmp_path: Path, max_depth: int | None
) -> None:
    """A contradiction is not clear where a neighbour is occupied, which may lie outside of the box."""
    edge = 1 if max_depth is None else 4
    wall, miss = cube((0, 0, 0), edge, [3.0, 0.0]), cube((0, 0, 0), edge, [-3.0, -3.0])
    beside = cube((edge, 0, 0), edge, [3.0, 0.0])
    seen = {"alpha": wall, "beta": miss | beside}

    def fill(writer: ResultWriter) -> None:
        for robot_id, cells in seen.items():
            data = encode_packet(octree_of(cells, resolution=0.2))
            writer.write_state(state(robot_id, 0, 1, data, key=True))
            writer.write_evidence(state(robot_id, 0, 4, data, key=True))

    with open_result(write_result(tmp_path, fill)) as result:
        part = MapPart(None, (0.0, 0.0, 0.0, 0.2 * edge, 0.2 * edge, 0.2 * edge), max_depth)
        stored = part.map(result, "alpha")
        leaves = stored.leaves()
        own = leaf_colors(result, [stored], leaves, "contradiction", part).colors
        assert own.tolist() == [list(CONTRADICTION_COLORS[CellContradiction.CONTRADICTION][1])]


def test_the_comments_name_the_bounds(pair_result: Path, tmp_path: Path) -> None:
    path = tmp_path / "map.ply"
    export_map(pair_result, path, bounds=(0.5, 1.5), max_depth=18)
    comments = PlyData.read(path).comments
    assert "bounds: 0.5, 1.5 m" in comments
    assert any(line.startswith("resolution 0.6 m") for line in comments)


def test_a_box_without_occupied_leaves_is_refused(walls: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no occupied leaf within the bounds; use --free, or other bounds"):
        export_map(walls, tmp_path / "map.ply", bounds=(-1.0, -1.0, 0.5, 0.0, -0.5, 1.0))
    assert not (tmp_path / "map.ply").exists()


@pytest.mark.parametrize("tile", [0.1, -5.0, 0.0, float("nan"), float("inf")])
def test_tiles_of_less_than_a_cell_are_refused(walls: Path, tmp_path: Path, tile: float) -> None:
    with pytest.raises(ConfigError, match=r"tile: expects an edge of at least one cell of the map, 0\.2 m"):
        export_map(walls, tmp_path / "map.ply", tile=tile)
    with pytest.raises(ConfigError, match=r"one cell of the map, 0\.8 m, got 0\.5"):
        export_map(walls, tmp_path / "map.ply", tile=0.5, max_depth=17)


def test_coarse_labels_are_those_of_posterior_and_mean(pair_result: Path) -> None:
    """The coarse posterior is the posterior of the coarse mean."""
    with open_result(pair_result) as result:
        stored = result.map("husky_1")
        assert stored.num_robots == 2
        coarse = stored.coarsened(17)
        fine = stored.leaves()
        occupied = fine.taken(best_labels(fine.log_odds) > 0)
        answer = coarse.query(occupied.centers)
        assert (answer.labels > 0).all()
        assert answer.known.all()
