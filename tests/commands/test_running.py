"""Tests of the commands 'run' and 'demo' and of those that read results, run as processes on the fixture teams."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from mcap.reader import make_reader
from plyfile import PlyData

from octoreplay.config.team_file import load_team_file
from octoreplay.result import open_result
from support.processes import fails, octoreplay

FIXTURES = Path(__file__).parents[1] / "fixtures"
PAIR = FIXTURES / "pair" / "team.yaml"


@pytest.fixture(scope="session")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Result of the team of two robots."""
    path = tmp_path_factory.mktemp("run") / "result.mcap"
    done = octoreplay("run", PAIR, "-o", path, "--state-every", "1", "--view-every", "2")
    assert done.returncode == 0, done.stderr
    assert re.fullmatch(r"(compiling kernels [^\n]*\n)?", done.stderr)
    assert "agreement, worst robot" in done.stdout
    assert f"wrote {path}" in done.stdout
    return path


def test_compilation_is_reported_once(result: Path, tmp_path: Path) -> None:
    for is_first in (True, False):
        done = subprocess.run(
            [sys.executable, "-m", "octoreplay", "query", str(result), "--at", "1", "0", "0"], text=True,
            capture_output=True, env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}, check=True, timeout=300,
        )  # fmt: skip
        assert done.stderr.startswith("compiling kernels") == is_first
        assert done.stderr.count("\n") == is_first


def test_a_team_file_with_every_kind_of_fault_runs(tmp_path: Path) -> None:
    (tmp_path / "team.yaml").write_text(
        PAIR.read_text().replace("log: ", f"publish_period: 1.0, log: {PAIR.parent}/")
        + "rule: flood\npackets: delta\ntopology: line\npublish_period: 0.5\nlatency: 0.2\njitter: 0.1\nloss: 0.2\n"
        + "links: [{from: husky_1, to: husky_2, corruption: 0.3}]\n"
        + "schedule: [{from: 1, to: 2, robots_off: [husky_2], forget: true}]\n"
    )
    done = octoreplay("run", tmp_path / "team.yaml", "-o", tmp_path / "x.mcap")
    assert done.returncode == 0, done.stderr
    with open_result(tmp_path / "x.mcap") as opened:
        assert opened.summary.last.robots[0].agreement > 0.9
        assert sum(link.num_lost for link in opened.summary.links) > 0


def test_equal_commands_and_config_from_give_equal_results(result: Path, tmp_path: Path) -> None:
    for arguments in ((PAIR, "--state-every", "1", "--view-every", "2"), ("--config-from", result)):
        again = tmp_path / "again.mcap"
        done = octoreplay("run", *arguments, "-o", again)
        assert done.returncode == 0, done.stderr
        assert messages(again) == messages(result)
    # In the same folder the logs have equal relative paths, so the metadata are equal too.
    twin = result.with_name("twin.mcap")
    assert octoreplay("run", "--config-from", result, "-o", twin).returncode == 0
    assert twin.read_bytes() == result.read_bytes()


def messages(path: Path) -> list[tuple[str, int, bytes]]:
    with path.open("rb") as stream:
        return [(channel.topic, m.log_time, m.data) for _, channel, m in make_reader(stream).iter_messages()]


def test_robots_detected_in_logs_can_be_saved_as_a_team_file(tmp_path: Path) -> None:
    logs = sorted((FIXTURES / "pair").glob("*.mcap"))
    team_file = tmp_path / "team.yaml"
    done = octoreplay("run", *logs, "--save-team", team_file, "--resolution", "0.4")
    assert done.returncode == 0, done.stderr
    assert "/husky_1/camera/depth/image_raw" in done.stdout
    assert f"saved {team_file}" in done.stdout
    config = load_team_file(team_file)
    assert config.map.resolution == 0.4
    assert [robot.robot_id for robot in config.robots] == ["husky_1", "husky_2"]
    assert all(log.samefile(original) for log, original in zip((r.logs[0] for r in config.robots), logs, strict=True))
    done = octoreplay("run", team_file, "-o", tmp_path / "out.mcap", "--settle", "0")
    assert done.returncode == 0, done.stderr


def test_a_changed_log_gives_a_warning(tmp_path: Path) -> None:
    for path in (FIXTURES / "pair").iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    first, second = tmp_path / "first.mcap", tmp_path / "second.mcap"
    assert octoreplay("run", tmp_path / "team.yaml", "-o", first, "--settle", "0").returncode == 0
    other = FIXTURES / "trio" / "husky_1.mcap"
    (tmp_path / "husky_1.mcap").write_bytes(other.read_bytes())
    done = octoreplay("run", "--config-from", first, "-o", second)
    assert "husky_1.mcap: has changed since first.mcap was made from it" in done.stderr


def test_a_truncated_log_is_used_up_to_its_end(tmp_path: Path) -> None:
    for path in (FIXTURES / "pair").iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    log = tmp_path / "husky_2.mcap"
    log.write_bytes(log.read_bytes()[: int(log.stat().st_size * 0.7)])
    done = octoreplay("run", tmp_path / "team.yaml", "-o", tmp_path / "out.mcap", "--settle", "0")
    assert done.returncode == 3, done.stderr
    assert re.search(r"warning: .*husky_2\.mcap", done.stderr)
    assert (tmp_path / "out.mcap").exists()


def test_metrics_shows_the_table_and_writes_csv_and_figures(result: Path, tmp_path: Path) -> None:
    done = octoreplay("metrics", result, "--csv", tmp_path / "m.csv", "--plot", tmp_path / "figures")
    assert done.returncode == 0, done.stderr
    assert "agreement, worst robot" in done.stdout
    assert "wall time" not in done.stdout
    with open_result(result) as opened:
        assert len((tmp_path / "m.csv").read_text().splitlines()) == len(opened.metrics) + 1
    assert sorted(path.name for path in (tmp_path / "figures").iterdir()) == ["disagreement.png", "packet_size.png"]


def test_export_writes_the_reported_number_of_cubes(result: Path, tmp_path: Path) -> None:
    done = octoreplay("export", result, "-o", tmp_path / "map.ply", "--what", "voxels", "--robot", "husky_2")
    assert done.returncode == 0, done.stderr
    count = int(re.search(r"\(([\d,]+) cubes", done.stdout)[1].replace(",", ""))
    data = PlyData.read(tmp_path / "map.ply")
    assert (data["vertex"].count, data["face"].count) == (8 * count, 12 * count)
    assert "octoreplay map of husky_2" in data.comments[0]
    fails(1, "robot 'husky_9' not found; robots: husky_1, husky_2", "export", result, "-o", tmp_path / "x.ply",
          "--robot", "husky_9")  # fmt: skip
    fails(2, r"out\.mcap: the name of the output must end in \.ply", "export", result, "-o", tmp_path / "out.mcap")
    fails(1, "is a folder or a device", "export", result, "-o", "/dev/full")
    fails(1, "no map of robot 'husky_1' is stored up to", "export", result, "-o", tmp_path / "x.ply", "--at", "-5")
    fails(1, r"none/x\.ply: cannot be written", "export", result, "-o", tmp_path / "none" / "x.ply")
    assert not (tmp_path / "x.ply").exists()


def test_query_shows_classes_at_points_and_in_a_box(result: Path) -> None:
    with open_result(result) as opened:
        stored = opened.map("husky_1")
        leaves = stored.leaves()
        index = int(leaves.log_odds.max(axis=1).argmax())
        x, y, z = leaves.centers[index]
        name = opened.class_table.names[int(leaves.log_odds[index].argmax())]
    done = octoreplay("query", result, "--at", x, y, z, "--at", 1e6, 0, 0, "--box", *(-100.0,) * 3, *(100.0,) * 3)
    assert done.returncode == 0, done.stderr
    assert re.search(rf"{name} +\d+\.\d\d %", done.stdout)
    assert re.search(r"1e\+06, 0, 0 +unknown", done.stdout)
    assert "m\u00b3" in done.stdout


def interrupted(
    arguments: list[object], ready: Callable[[], bool], number: signal.Signals
) -> subprocess.CompletedProcess[str]:
    """Run a command and send it a signal once ``ready`` returns True."""
    process = subprocess.Popen(
        [sys.executable, "-m", "octoreplay", *map(str, arguments)], stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True,
    )  # fmt: skip
    while process.poll() is None and not ready():
        time.sleep(0.02)
    process.send_signal(number)
    out, err = process.communicate(timeout=120)
    return subprocess.CompletedProcess(process.args, process.returncode, out, err)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_run_writes_a_partial_result_and_keeps_the_old_one(
    tmp_path: Path, number: signal.Signals
) -> None:
    out, partial = tmp_path / "out.mcap", tmp_path / "out.partial.mcap"
    out.write_text("the result of yesterday")
    # Long settling, so that the run has not ended when the signal arrives.
    arguments = ["run", PAIR, "-o", out, "--settle", "100000", "--settle-max", "100000", "--state-every", "0.001"]
    done = interrupted(arguments, lambda: partial.exists() and partial.stat().st_size > 20_000, number)
    assert done.returncode == 130, done.stderr
    assert f"interrupted; the finished part is in {partial}" in done.stderr
    assert out.read_text() == "the result of yesterday"
    with open_result(partial) as opened:
        assert opened.summary.stop_reason == "interrupted"
        assert len(opened.metrics) >= 1


def test_demo_writes_and_lists_all_files(tmp_path: Path) -> None:
    pytest.importorskip("open3d", exc_type=ImportError)
    done = octoreplay("demo", "show", "--robots", 2, "--duration", 3, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    for name in (
        "logs/team.yaml",
        "logs/world.ply",
        "result.mcap",
        "map.ply",
        "metrics.csv",
        "figures/disagreement.png",
    ):
        assert (tmp_path / "show" / name).exists()
        assert (tmp_path / "show" / name).stat().st_size > 0
    assert "Foxglove" in done.stdout
    fails(1, "show.*logs: is not empty; use a new folder", "demo", tmp_path / "show")


def test_a_part_of_the_logs_can_be_replayed(tmp_path: Path) -> None:
    done = octoreplay(
        "run", PAIR, "-o", tmp_path / "a.mcap", "--settle", "0", "--start", "1", "--duration", "2", "--every", "2"
    )
    assert done.returncode == 0
    with open_result(tmp_path / "a.mcap") as result:
        # Every second image of 2 s at 4 Hz.
        assert [counts.used for counts in result.summary.frame_counts.values()] == [4, 4]
        assert len(result.metrics) == 3
    fails(2, "hide_robots: no robot has a body_box", "run", PAIR, "-o", tmp_path / "b.mcap", "--hide-robots")
    fails(1, "no robot has a frame that can be used", "run", PAIR, "-o", tmp_path / "b.mcap", "--start", "99")
