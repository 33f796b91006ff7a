"""The command 'import-clouds'."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from octoreplay.commands.exit_codes import EXIT_DATA_LOST
from support.command_line import assert_fails, octoreplay


def save_wall(path: Path, viewpoint: str, *, extra: str = "") -> None:
    """Write a PCD file with a wall of label 7 at x = 2 m in the world frame, recorded at a viewpoint."""
    rows = [f"2.05 {y / 20} {z / 20} 7{extra}" for y in range(-20, 20) for z in range(20)]
    path.write_text(
        f"FIELDS x y z label\nSIZE 4 4 4 4\nTYPE F F F U\nWIDTH {len(rows)}\nHEIGHT 1\nVIEWPOINT {viewpoint}\n"
        "DATA ascii\n" + "\n".join(rows)
    )


@pytest.fixture
def walls(tmp_path: Path) -> Path:
    """Folder with three clouds of one wall, beside a team file that names its label."""
    (tmp_path / "in").mkdir()
    for index, viewpoint in enumerate(("0 0 0.5 1 0 0 0", "0.5 0.25 0.5 0.8 0 0 0.6", "-0.5 0 0.5 0.6 0 0 -0.8")):
        save_wall(tmp_path / "in" / f"{index}.pcd", viewpoint)
    (tmp_path / "team.yaml").write_text(
        "robots: [{id: a, log: a.mcap}]\nclasses: [{name: wall, raw_labels: [7]}, {name: floor, raw_labels: [8]}]\n"
    )
    return tmp_path / "in"


def test_a_folder_of_clouds_becomes_a_log_that_can_be_mapped(walls: Path, tmp_path: Path) -> None:
    log, out = tmp_path / "a.mcap", tmp_path / "out.mcap"
    done = octoreplay("import-clouds", walls, "-o", log, "--rate", 10, "--classes-from", tmp_path / "team.yaml")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == (
        f"wrote {log} (PCD: robot a, 3 clouds, 3 with labels, 0.2 s;"
        " poses from VIEWPOINT, points in the world's frame)\n"
    )
    done = octoreplay("run", log, "-o", out, "--resolution", "0.1")
    assert done.returncode == 0, done.stderr
    # The map does not depend on the viewpoints: a wall at x = 2 m, free space in front of it.
    done = octoreplay("query", out, "--point", 2.05, 0.05, 0.55, "--point", 1.5, 0.05, 0.55)
    assert re.search(r"2\.05, 0\.05, 0\.55 +[\d.]+ % +[\d.]+ % +wall", done.stdout), done.stdout
    assert re.search(r"1\.5, 0\.05, 0\.55 +[\d.]+ % +[\d.]+ % +free", done.stdout), done.stdout


def test_the_map_frame_is_named_and_a_log_is_never_overwritten_by_accident(walls: Path, tmp_path: Path) -> None:
    one, other = tmp_path / "a.mcap", tmp_path / "b.mcap"
    words = ("import-clouds", walls, "--rate", 10, "--map-frame")
    for path in (one, other):
        assert octoreplay(*words, "odom", "-o", path).returncode == 0
    assert "nothing relates the map frames of a ('odom') and b ('odom')" in octoreplay("info", one, other).stderr
    before = one.read_bytes()
    assert_fails(1, "a.mcap: already exists; give another name, or use --force", *words, "map", "-o", one)
    assert one.read_bytes() == before
    for path in (one, other):
        assert octoreplay(*words, "map", "-o", path, "--force").returncode == 0
    assert "nothing relates" not in octoreplay("info", one, other).stderr
    assert_fails(2, "map_frame: '' must not be empty", *words, "", "-o", one, "--force")


def test_odd_and_skipped_clouds_are_warned_of(walls: Path, tmp_path: Path) -> None:
    save_wall(walls / "1.pcd", "0 0 0 0 0 0 0", extra=" -1")
    save_wall(walls / "2.pcd", "0 0 1 1 0 0 0", extra=" -1")
    done = octoreplay("import-clouds", walls, "-o", tmp_path / "a.mcap", "--rate", 10)
    assert done.returncode == EXIT_DATA_LOST
    assert "2 clouds, 2 with labels" in done.stdout
    odd, skipped = done.stderr.splitlines()
    assert odd.startswith(f"warning: {walls / '2.pcd'}: rows have more columns than the header names; those after")
    assert skipped == "warning: 1 clouds without a usable pose were skipped"


def test_refused_folders_of_clouds(walls: Path, tmp_path: Path) -> None:
    out = tmp_path / "a.mcap"
    assert_fails(2, r"in: the frames have no times; give a rate or a file of times", "import-clouds", walls, "-o", out)
    assert_fails(
        2, r"a\.bag: the name of the output must end in \.mcap", "import-clouds", walls, "-o", tmp_path / "a.bag"
    )
    (walls / "1.pcd").write_bytes((walls / "1.pcd").read_bytes()[:-30])
    sentence = r"1\.pcd: is cut or damaged: .*; fetch it again or remove it"
    assert_fails(1, sentence, "import-clouds", walls, "-o", out, "--rate", 10)
    assert not out.exists()
