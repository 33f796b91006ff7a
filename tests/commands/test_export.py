"""The command 'export'."""

from __future__ import annotations

import re
from pathlib import Path

from plyfile import PlyData

from support.command_line import assert_fails, octoreplay


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
