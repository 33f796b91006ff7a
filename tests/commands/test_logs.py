"""Tests of the commands 'info', 'init' and 'import-clouds', run as processes."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from octoreplay.commands.exit_codes import EXIT_DATA_LOST
from octoreplay.config.team_file import load_team_file
from octoreplay.result import open_result
from support.processes import fails, octoreplay

FIXTURES = Path(__file__).parents[1] / "fixtures"
PAIR = FIXTURES / "pair" / "team.yaml"


def save_wall(path: Path, viewpoint: str, *, extra: str = "") -> None:
    """Write a PCD file of a wall with label 7 at x = 2 in the world's frame."""
    rows = [f"2.05 {y / 20} {z / 20} 7{extra}" for y in range(-20, 20) for z in range(20)]
    path.write_text(
        f"FIELDS x y z label\nSIZE 4 4 4 4\nTYPE F F F U\nWIDTH {len(rows)}\nHEIGHT 1\nVIEWPOINT {viewpoint}\n"
        "DATA ascii\n" + "\n".join(rows)
    )


@pytest.fixture
def walls(tmp_path: Path) -> Path:
    """Folder of three clouds of one wall, with a team file that names its label."""
    (tmp_path / "in").mkdir()
    for index, viewpoint in enumerate(("0 0 0.5 1 0 0 0", "0.5 0.25 0.5 0.8 0 0 0.6", "-0.5 0 0.5 0.6 0 0 -0.8")):
        save_wall(tmp_path / "in" / f"{index}.pcd", viewpoint)
    (tmp_path / "team.yaml").write_text(
        "robots: [{id: a, log: a.mcap}]\nclasses: [{name: wall, raw_labels: [7]}, {name: floor, raw_labels: [8]}]\n"
    )
    return tmp_path / "in"


def test_imported_clouds_can_be_replayed(walls: Path, tmp_path: Path) -> None:
    log, out = tmp_path / "a.mcap", tmp_path / "out.mcap"
    done = octoreplay("import-clouds", walls, "-o", log, "--rate", 10, "--classes-from", tmp_path / "team.yaml")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == (
        f"wrote {log} (PCD: robot a, 3 clouds, 3 with labels, 0.2 s;"
        " poses from VIEWPOINT, points in the world's frame)\n"
    )
    done = octoreplay("run", log, "-o", out, "--resolution", "0.1")
    assert done.returncode == 0, done.stderr
    # All three sensor poses give the wall at the same position, and free space before it.
    done = octoreplay("query", out, "--at", 2.05, 0.05, 0.55, "--at", 1.5, 0.05, 0.55)
    assert re.search(r"2\.05, 0\.05, 0\.55 +wall", done.stdout), done.stdout
    assert re.search(r"1\.5, 0\.05, 0\.55 +free", done.stdout), done.stdout


def test_skipped_and_odd_clouds_give_warnings(walls: Path, tmp_path: Path) -> None:
    save_wall(walls / "1.pcd", "0 0 0 0 0 0 0", extra=" -1")
    save_wall(walls / "2.pcd", "0 0 1 1 0 0 0", extra=" -1")
    done = octoreplay("import-clouds", walls, "-o", tmp_path / "a.mcap", "--rate", 10)
    assert done.returncode == EXIT_DATA_LOST
    assert "2 clouds, 2 with labels" in done.stdout
    odd, skipped = done.stderr.splitlines()
    assert odd.startswith(f"warning: {walls / '2.pcd'}: rows have more columns than the header names; those after")
    assert skipped == "warning: 1 clouds without a usable pose were skipped"


def test_clouds_that_cannot_be_imported_are_reported_in_one_sentence(walls: Path, tmp_path: Path) -> None:
    out = tmp_path / "a.mcap"
    fails(2, r"in: the frames have no times; give a rate or a file of times", "import-clouds", walls, "-o", out)
    fails(2, r"a\.bag: the name of the output must end in \.mcap", "import-clouds", walls, "-o", tmp_path / "a.bag")
    (walls / "1.pcd").write_bytes((walls / "1.pcd").read_bytes()[:-30])
    sentence = r"1\.pcd: is cut or damaged: .*; fetch it again or take it out"
    fails(1, sentence, "import-clouds", walls, "-o", out, "--rate", 10)
    assert not out.exists()


def test_info_describes_logs() -> None:
    done = octoreplay("info", *sorted((FIXTURES / "trio").glob("*.mcap")))
    assert done.returncode == 0, done.stderr
    assert "/husky_3/camera/depth/image_raw" in done.stdout
    assert "nothing is missing for a run" in done.stdout
    assert max(len(line) for line in done.stdout.splitlines()) <= 100


def test_init_writes_a_team_file_that_can_be_replayed(tmp_path: Path) -> None:
    logs = sorted((FIXTURES / "pair").glob("*.mcap"))
    team_file = tmp_path / "team.yaml"
    done = octoreplay("init", *logs, "-o", team_file)
    assert (done.returncode, done.stdout, done.stderr) == (0, f"wrote {team_file} (2 robots)\n", "")
    assert load_team_file(team_file).robots[0].pose_topic == "/husky_1/odom"
    fails(1, f"error: {team_file}: already exists; name another file, or use --force", "init", *logs, "-o", team_file)
    assert octoreplay("init", *logs, "-o", team_file, "--force").returncode == 0
    first, second = tmp_path / "first.mcap", tmp_path / "second.mcap"
    assert octoreplay("run", team_file, "-o", first, "--settle", "0").returncode == 0
    assert octoreplay("run", *logs, "-o", second, "--settle", "0").returncode == 0
    with open_result(first) as one, open_result(second) as other:
        for robot in one.robots:
            assert (one.map(robot).leaves().log_odds == other.map(robot).leaves().log_odds).all()


def test_init_reports_missing_data(tmp_path: Path) -> None:
    team_file = tmp_path / "team.yaml"
    done = octoreplay("init", FIXTURES / "containers" / "foxglove_json.mcap", "-o", team_file)
    assert done.returncode == 0
    assert "missing for a run: labels on " in done.stderr
    (tmp_path / "empty.bag").touch()
    fails(1, "the file is empty", "init", tmp_path / "empty.bag", "-o", tmp_path / "x.yaml")
    assert not (tmp_path / "x.yaml").exists()


def test_info_continues_after_a_log_that_cannot_be_opened(tmp_path: Path) -> None:
    done = octoreplay("info", tmp_path / "none.mcap", FIXTURES / "containers" / "lz4.bag")
    assert done.returncode == 1
    assert f"error: {tmp_path / 'none.mcap'}: no such file" in done.stderr
    assert "/camera/depth/image_raw" in done.stdout
