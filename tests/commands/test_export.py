"""The command 'export'."""

from __future__ import annotations

import re
from pathlib import Path

from plyfile import PlyData

from octoreplay.commands.results import export
from octoreplay.mapping.octree import KEY_BITS
from support.command_line import assert_fails, octoreplay, octoreplay_process
from support.long_suite import long


def test_export_of_voxels(pair_result: Path, tmp_path: Path) -> None:
    done = octoreplay("export", pair_result, "-o", tmp_path / "map.ply", "--what", "voxels", "--robot", "husky_2")
    assert done.returncode == 0, done.stderr
    count = int(re.search(r"\(([\d,]+) cubes", done.stdout)[1].replace(",", ""))
    data = PlyData.read(tmp_path / "map.ply")
    assert (data["vertex"].count, data["face"].count) == (8 * count, 12 * count)
    assert "octoreplay map of husky_2" in data.comments[0]


def test_refused_exports_write_nothing(pair_result: Path, tmp_path: Path) -> None:
    out = tmp_path / "x.ply"
    for code, sentence, arguments in (
        (1, "robot 'husky_9' not found; robots: husky_1, husky_2", (out, "--robot", "husky_9")),
        (2, r"out\.mcap: the name of the output must end in \.ply", (tmp_path / "out.mcap",)),
        (1, "is a folder or a device", ("/dev/full",)),
        (1, "no map of robot 'husky_1' is stored up to", (out, "--at", "-5")),
        (1, r"none/x\.ply: cannot be written", (tmp_path / "none" / "x.ply",)),
    ):
        assert_fails(code, sentence, "export", pair_result, "-o", *arguments)
    assert list(tmp_path.iterdir()) == []


@long
def test_a_part_of_a_map_in_tiles(pair_result: Path, tmp_path: Path) -> None:
    done = octoreplay_process(
        "export", pair_result, "-o", tmp_path / "map.ply", "--tile", 5, "--bounds", "-6,-6,0.3,6,6,2.1",
        "--max-depth", 18,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    files = sorted(tmp_path.iterdir())
    assert done.stdout == f"wrote {len(files)} files such as {tmp_path / 'map-x0_y-10.ply'}\n"
    assert len({path.stem for path in files} & {"map-x-10_y0", "map-x0_y-10", "map-x0_y0"}) == 3
    for path in files:
        data = PlyData.read(path)
        x, y = (int(number) for number in path.stem.removeprefix("map-x").split("_y"))
        assert x <= data["vertex"]["x"].min() <= data["vertex"]["x"].max() <= x + 5
        assert y <= data["vertex"]["y"].min() <= data["vertex"]["y"].max() <= y + 5
        assert data["vertex"]["size"].min() >= 0.6


def test_tiles_of_an_earlier_export_are_kept(pair_result: Path, tmp_path: Path) -> None:
    arguments = ("export", pair_result, "-o", tmp_path / "map.ply", "--tile", 5)
    (tmp_path / "map-x-12.5_y0.ply").write_bytes(b"earlier")
    assert_fails(1, r"map-x-12\.5_y0\.ply: already exists; .* --force", *arguments)
    assert [path.name for path in tmp_path.iterdir()] == ["map-x-12.5_y0.ply"]
    (tmp_path / "map-x-12.5_y0.ply").rename(tmp_path / "map-old.ply")
    assert octoreplay(*arguments).returncode == 0
    assert_fails(1, "already exists", *arguments)
    assert octoreplay(*arguments, "--force").returncode == 0


def test_refused_parts_write_nothing(pair_result: Path, tmp_path: Path) -> None:
    out = tmp_path / "x.ply"
    for code, sentence, arguments in (
        (2, "bounds: every minimum must be below its maximum", ("--bounds", "5,0,0,1,1,1")),
        (2, "bounds: no cell of the map has its centre in the box", ("--bounds", "0.5,0.7")),
        (2, "bounds: expects 2 or 6 numbers, got 1", ("--bounds", "3")),
        (2, "bounds: expects numbers, got 'a,b'", ("--bounds", "a,b")),
        (1, "holds no occupied leaf within the bounds; use --free, or other bounds", ("--bounds", "90,95")),
        (2, "tile: expects an edge of at least one cell of the map, 0.3 m, got 0.2", ("--tile", "0.2")),
        (2, "20 is not in the range 1<=x<=19", ("--max-depth", "20")),
        (2, "0 is not in the range 1<=x<=19", ("--max-depth", "0")),
    ):
        assert_fails(code, re.escape(sentence), "export", pair_result, "-o", out, *arguments)
    assert list(tmp_path.iterdir()) == []


def test_the_deepest_level_of_the_option_is_that_of_the_octree() -> None:
    option = next(parameter for parameter in export.params if parameter.name == "max_depth")
    assert option.type.max == KEY_BITS
