"""Tests of the paper's experiment, run as a process with a small team."""

from __future__ import annotations

import json
import signal
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from octoreplay.errors import ConfigError, InputError
from octoreplay.report import map_view
from octoreplay.result import Result, open_result
from octoreplay.simulate.settings import SimulationConfig
from octoreplay.study import paper
from support.command_line import octoreplay, started, wait_for

pytestmark = pytest.mark.long

FIGURES = ("agreement.png", "maps.png", "packet_size.png", "total_distance.png")


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the experiment with two robots over six seconds."""
    pytest.importorskip("open3d", exc_type=ImportError)
    folder = tmp_path_factory.mktemp("experiment") / "paper"
    process = octoreplay("experiment", "paper", folder, "--duration", 6, "--robots", 2)
    assert process.returncode == 0, process.stderr
    assert f"simulated the team in {folder / 'team'}\n" in process.stderr
    assert f"wrote {folder / 'paper.mcap'}\n" in process.stderr
    assert "uniform grid / octree" in process.stdout
    return folder


@pytest.fixture
def result(done: Path) -> Result:
    with open_result(done / "paper.mcap") as opened:
        yield opened


def test_the_folder_holds_team_result_figures_and_numbers(done: Path) -> None:
    assert sorted(path.name for path in done.iterdir()) == ["figures", "numbers.json", "paper.mcap", "team"]
    assert sorted(path.name for path in (done / "figures").iterdir()) == sorted(FIGURES)
    team = {path.name for path in (done / "team").iterdir()}
    assert team == {"husky_1.mcap", "husky_2.mcap", "simulation.json", "team.yaml", "world.npz", "world.ply"}


def test_the_run_has_the_papers_settings(result: Result) -> None:
    config = result.config
    assert (config.consensus.rule, config.consensus.mode, config.network.topology) == (
        "gradient", "on-arrival", "complete",
    )  # fmt: skip
    assert config.network.publish_period == 1.0
    assert config.consensus.settle == 0
    assert result.metrics[-1].tick == 6


def test_the_numbers_match_the_result(done: Path, result: Result) -> None:
    numbers = json.loads((done / "numbers.json").read_text(encoding="utf-8"))
    assert (numbers["preset"], numbers["simulation"]["num_robots"], numbers["simulation"]["duration"]) == (
        "paper",
        2,
        6,
    )
    metrics = result.metrics
    assert numbers["peak_total_distance"] == max(tick.total_distance for tick in metrics)
    assert metrics[int(numbers["peak_seconds"])].total_distance == numbers["peak_total_distance"]
    published = [tick for tick in metrics if any(robot.grid_bytes for robot in tick.robots)]
    assert len(published) >= 4
    ratios = [
        np.mean([robot.grid_bytes for robot in tick.robots]) / np.mean([robot.octree_bytes for robot in tick.robots])
        for tick in published
    ]
    assert numbers["mean_ratio"] == pytest.approx(np.mean(ratios))
    assert numbers["least_ratio"] == pytest.approx(min(ratios))
    assert [moment["seconds"] for moment in numbers["moments"]] == [2.0, 6.0]
    for moment in numbers["moments"]:
        tick = metrics[int(moment["seconds"])]
        for name in ("total_distance", "label_disagreement", "num_known_cells"):
            assert moment[name] == getattr(tick, name)
        for name in ("octree_bytes", "grid_bytes"):
            assert moment[name] == pytest.approx(np.mean([getattr(robot, name) for robot in tick.robots]))
            assert moment[f"{name}_std"] == pytest.approx(np.std([getattr(robot, name) for robot in tick.robots]))
        assert moment["agreement"] == min(robot.agreement for robot in tick.robots)
        assert moment["agreement_occupied"] == min(robot.agreement_occupied for robot in tick.robots)
        assert moment["ratio"] == pytest.approx(moment["grid_bytes"] / moment["octree_bytes"])


def test_phi_is_the_sum_over_links_of_the_squared_distance_over_cells(done: Path, result: Result) -> None:
    numbers = json.loads((done / "numbers.json").read_text(encoding="utf-8"))
    first, second = (result.map(robot_id).octree for robot_id in result.robots)
    keys = np.argwhere(np.ones((340, 340, 60))) - (170, 170, 10)
    centers = (keys + 0.5) * first.resolution
    h = [octree.lookup(centers)[0].astype(float) for octree in (first, second)]
    distance = np.square(h[0] - h[1]).sum()
    assert numbers["moments"][-1]["total_distance"] == pytest.approx(distance, rel=1e-5)
    relative = distance / np.mean([np.square(values).sum() for values in h])
    assert numbers["moments"][-1]["relative_distance"] == pytest.approx(relative, rel=1e-5)


def test_pictures_show_the_mapped_cells(done: Path, result: Result) -> None:
    for name in FIGURES:
        with Image.open(done / "figures" / name) as image:
            assert len(np.unique(np.asarray(image.convert("RGB")).reshape(-1, 3), axis=0)) > 50, name
    with Image.open(done / "figures" / "maps.png") as image:
        maps = np.asarray(image.convert("RGB")).astype(int)
    background = np.abs(maps - map_view.BACKGROUND).max(axis=2) <= 3
    early, late, village = background[60:240, 810:], background[60:490, :800], background[300:490, 810:]
    # Cells that two robots see in two seconds and in six, and the whole village.
    assert 0.005 < 1 - early.mean() < 0.1
    assert 0.02 < 1 - late.mean() < 0.3
    assert 1 - village.mean() > 0.4


def test_a_complete_team_and_result_are_used_again(done: Path) -> None:
    before = {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in done.rglob("*.*") if path.is_file()}
    process = octoreplay("experiment", "paper", done, "--duration", 6, "--robots", 2)
    assert process.returncode == 0, process.stderr
    assert f"used the team in {done / 'team'} again\n" in process.stderr
    assert f"used {done / 'paper.mcap'} again\n" in process.stderr
    for path, (changed, content) in before.items():
        assert path.read_bytes() == content, path
        assert path.parent == done / "figures" or path.suffix == ".json" or path.stat().st_mtime_ns == changed


def test_other_settings_are_refused_in_a_used_folder(done: Path) -> None:
    process = octoreplay("experiment", "paper", done, "--duration", 6, "--robots", 2, "--seed", 1)
    assert process.returncode == 1
    assert "team: holds a team with seed 0, not 1; give another folder, or remove this one" in process.stderr


def test_a_folder_with_other_files_is_refused(tmp_path: Path) -> None:
    (tmp_path / "team").mkdir()
    (tmp_path / "team" / "names.txt").write_text("Ann")
    process = octoreplay("experiment", "paper", tmp_path, "--duration", 6)
    assert process.returncode == 1
    assert "holds no simulated team" in process.stderr
    assert "Traceback" not in process.stderr
    assert [path.name for path in tmp_path.rglob("*")] == ["team", "names.txt"]


def test_an_interrupt_leaves_nothing_half_written(tmp_path: Path) -> None:
    pytest.importorskip("open3d", exc_type=ImportError)
    arguments = ("experiment", "paper", tmp_path / "paper", "--duration", 60)
    with started(*arguments) as process:
        wait_for(lambda: any((tmp_path / "paper").glob(".team.*.tmp")))
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=120)
    assert process.returncode == 130, err
    assert not (tmp_path / "paper").exists()


def test_too_short_a_duration_is_refused(tmp_path: Path) -> None:
    process = octoreplay("experiment", "paper", tmp_path / "paper", "--duration", 5)
    assert process.returncode == 2
    assert "duration: 5 s is too short for the experiment; use at least 6 s" in process.stderr
    assert not (tmp_path / "paper").exists()
    with pytest.raises(ConfigError):
        paper.paper_team(duration=5.9)


def test_the_python_function_gives_the_same_numbers(done: Path) -> None:
    simulation = SimulationConfig(num_robots=2, duration=6.0)
    assert paper.paper_team(2, 6.0) == simulation
    numbers = paper.run_paper(done, simulation)
    stored = json.loads((done / "numbers.json").read_text(encoding="utf-8"))
    assert stored["mean_ratio"] == numbers.mean_ratio
    assert stored["moments"][1]["median_deviation"] == numbers.moments[1].median_deviation


def test_maps_without_occupied_cells_are_reported_in_one_sentence() -> None:
    empty = map_view.Overlay(np.zeros((0, 3)), np.zeros(0, np.uint8), np.zeros(0), 0.3)
    with pytest.raises(InputError, match="hold no occupied cell; use a longer duration"):
        paper.transparent_deviation([empty])
