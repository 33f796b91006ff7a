"""The command 'align' and the option 'run --align'."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from octoreplay.config.frames_file import load_frames_file
from octoreplay.config.team_file import dump_team, load_team_file
from octoreplay.result import open_result
from octoreplay.simulate.settings import SimulationConfig
from octoreplay.simulate.team import simulate_team
from octoreplay.transforms import inverse, pose_difference, transform_of
from support.command_line import assert_fails, octoreplay
from support.fixture_paths import PAIR_TEAM
from support.long_suite import long


@pytest.fixture(scope="module")
def twins(shared_file) -> Path:
    """Folder with one robot's log under two names."""

    def make(folder: Path) -> None:
        simulate_team(
            folder,
            SimulationConfig(
                num_robots=1,
                duration=6.0,
                rate=2.0,
                image=(96, 72),
                own_frames=True,
                world_size=40.0,
                seed=3,
                fixes=0.05,
            ),
        )
        shutil.copy(folder / "husky_1.mcap", folder / "twin.mcap")

    return shared_file("twins", make)


@long
def test_align_writes_a_team_file_that_a_run_takes(twins, tmp_path):
    logs = (twins / "husky_1.mcap", twins / "twin.mcap")
    done = octoreplay("align", *logs, "-o", "aligned.yaml", "--json", "--csv", "a.csv", "--plot", "plots",
                      folder=tmp_path)  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "accepted" in done.stderr
    assert [pair["accepted"] for pair in json.loads(done.stdout)["pairs"]] == [True]
    assert "have equal maps: are their logs the same?" in done.stderr
    team = load_team_file(tmp_path / "aligned.yaml")
    assert [robot.robot_id for robot in team.robots] == ["husky_1", "twin"]
    assert team.robots[1].T_team_map_from.startswith("aligned with husky_1; agrees with position fixes (L ")
    shift, angle = pose_difference(transform_of(team.robots[1].T_team_map), np.eye(4))
    assert (shift, angle) == pytest.approx((0, 0), abs=1e-3)
    assert {path.name for path in (tmp_path / "plots").iterdir()} == {"team.png", "pair_husky_1_twin.png"}
    assert (tmp_path / "a.csv").stat().st_size > 0


@long
def test_run_align_stores_the_origin_of_each_frame_and_align_reads_the_stored_evidence(twins, tmp_path):
    logs = (twins / "husky_1.mcap", twins / "twin.mcap")
    done = octoreplay("run", "--align", *logs, "-o", "r.mcap", "--settle", 0, "--strict-frames", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "nothing relates the map frames" not in done.stderr
    shown = octoreplay("metrics", "r.mcap", "-v", folder=tmp_path).stdout
    assert "twin: aligned with husky_1; agrees with position fixes (L " in " ".join(shown.split())
    with open_result(tmp_path / "r.mcap") as result:
        origins = result.summary.frame_origins
        assert origins["husky_1"] == "frame of the team"
        assert result.config.robots[1].T_team_map_from == origins["twin"]
    again = octoreplay("align", "r.mcap", "-o", "again.yaml", folder=tmp_path)
    assert again.returncode == 0, again.stderr
    T = transform_of(load_team_file(tmp_path / "again.yaml").robots[1].T_team_map)
    assert pose_difference(T, np.eye(4))[0] < 0.02
    result = "r.mcap: is a result of octoreplay, not a log; .* 'octoreplay run --config-from .*r.mcap'"
    assert_fails(1, result, "run", tmp_path / "r.mcap", "-o", tmp_path / "x.mcap")
    assert_fails(2, "holds finished maps; leave out --resolution", "align", tmp_path / "r.mcap", "-o",
                 tmp_path / "x.yaml", "--resolution", 0.5)  # fmt: skip


@long
def test_run_align_of_a_team_file_names_and_leaves_out_a_robot_that_is_not_connected(twins, tmp_path):
    config = load_team_file(twins / "team.yaml")
    (robot,) = (robot.with_absolute_paths() for robot in config.robots)
    far = load_team_file(PAIR_TEAM).robots[0].with_absolute_paths()
    robots = (
        robot,
        dataclasses.replace(far, robot_id="far"),
        dataclasses.replace(robot, robot_id="twin", logs=(twins / "twin.mcap",)),
    )
    (tmp_path / "team.yaml").write_text(dump_team(dataclasses.replace(config, robots=robots)))
    done = octoreplay("run", "team.yaml", "--align", "-o", "r.mcap", "--settle", 0, "--duration", 5, folder=tmp_path)
    assert done.returncode == 3, done.stderr
    assert "far is not connected; its best pair is" in done.stderr
    with open_result(tmp_path / "r.mcap") as result:
        assert result.robots == ("husky_1", "twin")


@long
def test_a_cut_log_is_named_and_the_exit_code_says_that_data_was_lost(twins, tmp_path):
    for name in ("husky_1.mcap", "twin.mcap"):
        shutil.copy(twins / name, tmp_path)
    log = tmp_path / "twin.mcap"
    log.write_bytes(log.read_bytes()[: int(log.stat().st_size * 0.7)])
    done = octoreplay("align", "husky_1.mcap", "twin.mcap", "-o", "aligned.yaml", folder=tmp_path)
    assert done.returncode == 3, done.stderr
    assert "warning: twin.mcap: cut before its end" in done.stderr
    assert (tmp_path / "aligned.yaml").exists()


def test_words_of_run_align_that_do_not_fit_are_named(twins, tmp_path):
    out = tmp_path / "out.mcap"
    sideways = r"'sideways' is no file and no value of --align \(before, on-air, off\)"
    assert_fails(2, sideways, "run", PAIR_TEAM, "--align", "sideways", "-o", out)
    assert_fails(2, "--dof needs --align$", "run", PAIR_TEAM, "--dof", 6, "-o", out)
    assert_fails(2, "--dof needs --align; robots that align on air", "run", PAIR_TEAM, "--align", "on-air",
                 "--dof", 6, "-o", out)  # fmt: skip


def test_robots_without_overlap_give_a_reason_and_no_team_file(tmp_path):
    done = octoreplay("align", PAIR_TEAM, "-o", "out.yaml", "--csv", "pairs.csv", "--max-range", 0.2, folder=tmp_path)
    assert done.returncode == 1
    assert "error: no two of the 2 robots could be aligned; the best pair is" in done.stderr
    assert not (tmp_path / "out.yaml").exists()
    assert "fewer than 150" in (tmp_path / "pairs.csv").read_text()


def test_wrong_inputs_are_named(tmp_path):
    out = tmp_path / "out.yaml"
    guess = tmp_path / "guess.yaml"
    guess.write_text("T_team_map: {nobody: [0, 0, 0, 0, 0, 0, 1]}\n")
    assert_fails(2, "guess: robot 'nobody' is not in the team", "align", PAIR_TEAM, "-o", out, "--guess", guess)
    assert_fails(2, "missing.yaml: cannot be read", "align", PAIR_TEAM, "-o", out, "--guess", tmp_path / "missing.yaml")
    assert_fails(2, "must end in .yaml", "align", PAIR_TEAM, "-o", tmp_path / "out.txt")
    assert_fails(1, "is an input of this command", "align", PAIR_TEAM, "-o", PAIR_TEAM)
    assert_fails(1, "is a file; name a folder", "align", PAIR_TEAM, "-o", out, "--plot", guess)
    assert not out.exists()


@pytest.mark.parametrize(("own", "following"), [((), "run"), (("--own-frames",), "align")])
def test_simulate_names_the_next_command(own, following, tmp_path):
    size = ("--robots", 1, "--duration", 1, "--rate", 1, "--image", "16x12", "--world-size", 20)
    done = octoreplay("simulate", "team", *size, *own, folder=tmp_path)
    assert f"next: octoreplay {following} team/team.yaml -o team/" in done.stdout


@long
def test_a_simulated_team_with_frames_of_its_own_is_aligned(tmp_path):
    simulate_team(tmp_path / "team", SimulationConfig(num_robots=3, duration=60.0, own_frames=True, seed=0))
    done = octoreplay("align", "team/team.yaml", "-o", "aligned.yaml", "--components", folder=tmp_path)
    truth = load_frames_file(tmp_path / "team" / "frames.yaml")
    robots = load_team_file(tmp_path / "aligned.yaml").robots
    assert done.returncode == (0 if len(robots) == 3 else 1)
    assert len(robots) > 1
    T_team_truth = inverse(transform_of(truth[robots[0].robot_id]))
    for robot in robots:
        shift, angle = pose_difference(
            transform_of(robot.T_team_map), T_team_truth @ transform_of(truth[robot.robot_id])
        )
        assert shift < 0.5
        assert angle < np.radians(1.5)
