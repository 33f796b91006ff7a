"""Teams of team files: their frames, those that are refused, and an experiment from beginning to end."""

from __future__ import annotations

import csv
import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest

from octoreplay.config.team_file import dump_team, load_team_file
from octoreplay.errors import ConfigError
from octoreplay.simulate.settings import SimulationConfig
from octoreplay.simulate.team import simulate_team
from octoreplay.study.given_teams import GivenTeam, check_given
from octoreplay.study.real_teams import teams_of
from octoreplay.study.recorded_teams import RecordedTeam
from octoreplay.study.team_frames import ALIGNED, FRAMES, MAX_SHIFT, RIGHT, UNALIGNED, frame_errors
from octoreplay.transforms import inverse, transform_of
from support.command_line import assert_fails, octoreplay_process
from support.fixture_paths import PAIR

SHIFTED = (5.0, -2.0, 0.5, 0.0, 0.0, 0.0, 1.0)


def pair(folder: Path, **values: object) -> Path:
    """Team file of the pair, in a folder of its own, the second robot with these values."""
    folder.mkdir(parents=True)
    for name in ("husky_1.mcap", "husky_2.mcap"):
        shutil.copy(PAIR / name, folder / name)
    config = load_team_file(PAIR / "team.yaml")
    robots = tuple(dataclasses.replace(robot, logs=(folder / robot.logs[0].name,)) for robot in config.robots)
    config = dataclasses.replace(config, robots=(robots[0], dataclasses.replace(robots[1], **values)))
    path = folder / "team.yaml"
    path.write_text(dump_team(config, folder))
    return path


def test_a_team_file_has_right_frames_and_frames_of_each_robots_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = pair(tmp_path / "team", T_team_map=SHIFTED, T_team_map_sigma=(0.1,) * 6, T_team_map_from="a survey")
    monkeypatch.chdir(path.parent)
    teams = {frames: GivenTeam(Path("team.yaml"), frames, 4) for frames in FRAMES}
    folder = tmp_path / "out" / teams[RIGHT].folder_name
    assert {team.folder_name for team in teams.values()} == {folder.name}
    shares: list[float] = []
    teams[RIGHT].write(folder, shares.append)
    assert shares[-1] == 1.0

    given = load_team_file(path.resolve())
    right, own = (load_team_file(teams[frames].team_file("a", folder) or path) for frames in (RIGHT, UNALIGNED))
    assert right == given
    assert teams[RIGHT].right_config(right) == given
    assert teams[RIGHT].num_robots == 2
    assert [robot.logs for robot in own.robots] == [robot.logs for robot in given.robots]
    for robot, true in zip(own.robots, given.robots, strict=True):
        # The given frame is turned about z and shifted.
        T = transform_of(robot.T_team_map) @ inverse(transform_of(true.T_team_map_or_identity))
        np.testing.assert_allclose(T[2, :3], [0.0, 0.0, 1.0], atol=1e-9)
        assert 0.0 < abs(T[:3, 3]).max() <= MAX_SHIFT
        assert robot.T_team_map_sigma is robot.T_team_map_from is None
    assert frame_errors(given, right) == pytest.approx((0.0, 0.0), abs=1e-5)
    assert frame_errors(given, own)[0] > 0.1

    # The pair sees little in common, so that align finds its frames or refuses them, and never takes the given ones.
    aligned = teams[ALIGNED].team_file("a", folder)
    if aligned is not None:
        assert "a survey" not in aligned.read_text()
    before = {file.name: file.stat().st_mtime_ns for file in folder.iterdir()}
    teams[RIGHT].write(folder, shares.append)
    assert {file.name: file.stat().st_mtime_ns for file in folder.iterdir()} == before


def test_the_folder_changes_with_the_team_file_and_its_logs(tmp_path: Path) -> None:
    path = pair(tmp_path / "team")
    names = [GivenTeam(path, RIGHT, 0).folder_name, GivenTeam(path, RIGHT, 1).folder_name]
    path.write_text(path.read_text() + "max_range: 5.0\n")
    names.append(GivenTeam(path, RIGHT, 0).folder_name)
    shutil.copy(path.parent / "husky_2.mcap", path.parent / "husky_1.mcap")
    names.append(GivenTeam(path, RIGHT, 0).folder_name)
    assert len(set(names)) == 4


def test_teams_without_known_frames_and_single_robots_are_refused(tmp_path: Path) -> None:
    unrelated = tmp_path / "unrelated" / "team.yaml"
    simulate_team(unrelated.parent, SimulationConfig(num_robots=2, duration=2.0, rate=1.0, own_frames=True))
    with pytest.raises(ConfigError, match=r"unrelated/team\.yaml: strict_frames: .*T_team_map"):
        check_given(unrelated)
    check_given(pair(tmp_path / "given", T_team_map=SHIFTED))

    config = load_team_file(PAIR / "team.yaml")
    single = tmp_path / "single.yaml"
    single.write_text(dump_team(dataclasses.replace(config, robots=config.robots[:1]), tmp_path))
    with pytest.raises(ConfigError, match=r"single\.yaml: has one robot"):
        check_given(single)

    missing = tmp_path / "missing.yaml"
    missing.write_text("robots: [{id: a, log: a.mcap}, {id: b, log: b.mcap}]\n")
    assert_fails(1, "missing.yaml: .*a.mcap: no such file", "experiment", "real", tmp_path / "out", "--data", missing)
    # Exit code 2, as of every command with a team file that cannot be read.
    nowhere, reason = tmp_path / "nowhere.yaml", "nowhere.yaml: cannot be read: No such file"
    assert_fails(2, reason, "experiment", "real", tmp_path / "out", "--data", nowhere)
    assert not (tmp_path / "out").exists()


def test_a_team_that_aligns_during_the_run_is_replayed_with_its_frames(tmp_path: Path) -> None:
    path = pair(tmp_path / "team", T_team_map=SHIFTED)
    path.write_text(path.read_text() + "align: on-air\n")
    team = GivenTeam(path, RIGHT, 0)
    team.write(tmp_path / "out", lambda _: None)
    assert not load_team_file(tmp_path / "out" / "right.yaml").alignment.is_on_air


def test_folders_and_team_files_are_numbered_together(tmp_path: Path) -> None:
    path = pair(tmp_path / "team")
    room = tmp_path / "room"
    room.mkdir()
    for index in range(64):
        (room / f"frame-{index:06d}.depth.png").touch()
        (room / f"frame-{index:06d}.pose.txt").write_text("1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    teams = teams_of([path, room], (RIGHT, ALIGNED))
    assert list(teams) == [f"{frames}_{seed}" for seed in range(10) for frames in (RIGHT, ALIGNED)]
    assert [type(team) for team in teams.values()] == [GivenTeam] * 2 + [RecordedTeam] * 18
    assert all(label == f"{team.frames}_{team.seed}" for label, team in teams.items())


@pytest.mark.long
def test_a_team_file_from_beginning_to_end(tmp_path: Path) -> None:
    path = pair(tmp_path / "team")
    done = octoreplay_process("experiment", "real", tmp_path / "real", "--data", path)
    assert done.returncode == 0, done.stderr
    rows = list(csv.DictReader((tmp_path / "real" / "real.csv").read_text(encoding="utf-8").splitlines()))
    assert {row["frames"] for row in rows} >= {RIGHT, UNALIGNED}
    right, own = ([row for row in rows if row["frames"] == frames] for frames in (RIGHT, UNALIGNED))
    assert [row["rule"] for row in right] == [row["rule"] for row in own] == ["bayes", "flood", "gradient"]
    assert all(float(row["frame_shift"]) == pytest.approx(0.0, abs=1e-6) for row in right)
    assert all(float(row["frame_shift"]) > 0.1 for row in own)
    assert float(own[0]["num_known_cells"]) > float(right[0]["num_known_cells"])


@pytest.mark.long
def test_a_team_without_occupied_cells_has_no_share_of_them(tmp_path: Path) -> None:
    path = pair(tmp_path / "team")
    path.write_text(path.read_text() + "max_range: 0.5\n")
    done = octoreplay_process("experiment", "real", tmp_path / "real", "--data", path)
    assert done.returncode == 0, done.stderr
    rows = list(csv.DictReader((tmp_path / "real" / "real.csv").read_text(encoding="utf-8").splitlines()))
    assert {row["erased"] for row in rows} == {"nan"}
