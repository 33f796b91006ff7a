"""The command 'refine'."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from evo.core import metrics, sync
from evo.tools import file_interface

from octoreplay.config.robot import RobotConfig
from octoreplay.config.team_file import dump_team, load_team_file
from octoreplay.io.datasets.pose_files import read_tum_track, write_tum
from octoreplay.io.robots.discover import resolve
from octoreplay.io.robots.robot_log import RobotLog
from octoreplay.simulate.settings import SimulationConfig
from octoreplay.simulate.team import simulate_team
from octoreplay.transforms import numbers_of, transform_of
from support.command_line import assert_fails, octoreplay
from support.fixture_paths import PAIR, PAIR_TEAM
from support.long_suite import long

DRIFT = ("--drift", "2,1.5")


@pytest.fixture(scope="session")
def team(shared_file: Callable[..., Path]) -> Path:
    """Team file of two robots with drift that see the same houses, with the truth beside it."""

    def make(folder: Path) -> None:
        simulate_team(
            folder,
            SimulationConfig(
                num_robots=2, duration=40.0, rate=2.5, image=(96, 72), seed=7, world_size=20.0, label_noise=0.0,
                odometry_drift=(2.0, 1.5),
            ),
        )  # fmt: skip

    return shared_file("drifting_pair", make) / "team.yaml"


@pytest.fixture(scope="session")
def refined(team: Path, shared_file: Callable[..., Path]) -> Path:
    """Refined team file."""

    def make(folder: Path) -> None:
        folder.mkdir()
        done = octoreplay(
            "refine", team, "-o", folder / "refined.yaml", "--truth", team.parent, "--plot", folder / "refined.png",
            *DRIFT,
        )  # fmt: skip
        (folder / "shown.txt").write_text(f"{done.returncode}\n{done.stdout}\n{done.stderr}")

    return shared_file("refined_pair", make) / "refined.yaml"


def trajectory_error(team: Path, poses: Path, T_team_map: dict[str, np.ndarray]) -> float:
    """Root mean square of both robots' position errors in the team's frame, computed by evo [m]."""
    squares = []
    for robot_id, T in T_team_map.items():
        true = file_interface.read_tum_trajectory_file(team.parent / "truth" / f"{robot_id}.tum")
        found = file_interface.read_tum_trajectory_file(poses / f"{robot_id}.tum")
        found.transform(T)
        error = metrics.APE(metrics.PoseRelation.translation_part)
        error.process_data(sync.associate_trajectories(true, found))
        squares.append(np.square(error.error))
    return float(np.sqrt(np.concatenate(squares).mean()))


def frames_of(team: Path) -> dict[str, np.ndarray]:
    """T_team_map (4, 4) of each robot."""
    return {robot.robot_id: transform_of(robot.T_team_map_or_identity) for robot in load_team_file(team).robots}


def recorded_poses(team: Path, folder: Path) -> Path:
    """The recorded trajectories as TUM files."""
    config = resolve(load_team_file(team))
    for robot in config.robots:
        with RobotLog(robot, config.time, config.classes) as log:
            source = log.pose_source()
            stamps = [m.header_stamp_ns() for m in log.pose_messages(source, 0) if m.topic == robot.pose_topic]
            mount = source.T_body_sensor_at(stamps[0])
            poses = np.array([source.at(stamp) for stamp in stamps]) @ np.linalg.inv(mount)
        write_tum(folder / f"{robot.robot_id}.tum", stamps, poses)
    return folder


@long
def test_refine_reports_and_writes_what_evo_reads(team: Path, refined: Path, tmp_path: Path) -> None:
    code, shown = (refined.parent / "shown.txt").read_text().split("\n", 1)
    assert code == "0"
    assert shown.count("corrected") == 2
    assert f"wrote {refined}" in shown
    assert (refined.parent / "refined.png").stat().st_size > 10_000
    after = trajectory_error(team, refined.parent / "refined-poses", frames_of(refined))
    before = trajectory_error(team, recorded_poses(team, tmp_path), frames_of(team))
    assert before > 0.3
    assert after < 0.8 * before


@long
def test_the_refined_team_gives_sensor_poses_of_the_corrected_trajectory(team: Path, refined: Path) -> None:
    before, after = resolve(load_team_file(team)), resolve(load_team_file(refined))
    for old, new in zip(before.robots, after.robots, strict=True):
        with (
            RobotLog(old, before.time, before.classes) as old_log,
            RobotLog(new, after.time, after.classes) as new_log,
        ):
            frames = list(zip(old_log.frames(), new_log.frames(), strict=True))
            mount = old_log.pose_source().T_body_sensor_at(frames[0][0].stamp_ns)
        assert new.pose_topic is None
        assert new_log.counts.no_pose == 0
        np.testing.assert_allclose(transform_of(new.T_body_sensor), mount, atol=1e-9)
        # The first recorded pose begins the corrected trajectory in the map frame.
        T_map_sensor = np.linalg.inv(transform_of(new.T_team_map_or_identity)) @ frames[0][1].T_team_sensor
        recorded = np.linalg.inv(transform_of(old.T_team_map_or_identity)) @ frames[0][0].T_team_sensor
        np.testing.assert_allclose(T_map_sensor, recorded, atol=0.02)
        truth = read_tum_track(team.parent / "truth" / f"{new.robot_id}.tum")
        true = np.array([truth.matrix_at(a.stamp_ns, 10**9)[:3, 3] for a, _ in frames])
        of_old = np.array([(a.T_team_sensor @ np.linalg.inv(mount))[:3, 3] for a, _ in frames])
        of_new = np.array([(b.T_team_sensor @ np.linalg.inv(mount))[:3, 3] for _, b in frames])
        assert np.linalg.norm(of_new - true, axis=1).mean() < np.linalg.norm(of_old - true, axis=1).mean()


@pytest.mark.long
def test_refining_again_changes_little(refined: Path, tmp_path: Path) -> None:
    again = tmp_path / "again.yaml"
    assert octoreplay("refine", refined, "-o", again, "--drift", "0.3,0.2").returncode == 0
    for robot_id in ("husky_1", "husky_2"):
        first = read_tum_track(refined.parent / "refined-poses" / f"{robot_id}.tum")
        path = load_team_file(again).robots[int(robot_id[-1]) - 1].pose_file
        assert path is not None
        assert np.abs(read_tum_track(path).positions - first.positions).max() < 0.3


def test_robots_without_overlap_keep_their_poses(team: Path, tmp_path: Path) -> None:
    config = load_team_file(team)
    robots = tuple(robot.with_absolute_paths() for robot in config.robots)
    far = (900.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    parts = dataclasses.replace(
        config,
        robots=(robots[0], dataclasses.replace(robots[1], T_team_map=far)),
        time=dataclasses.replace(config.time, duration=5.0),
    )
    apart, output = tmp_path / "apart.yaml", tmp_path / "out.yaml"
    apart.write_text(dump_team(parts))
    done = octoreplay("refine", apart, "-o", output)
    assert done.returncode == 0
    assert done.stdout.count("as recorded") == 2
    assert not (tmp_path / "out-poses").exists()
    assert load_team_file(output) == load_team_file(apart)


def refused(tmp_path: Path, robots: tuple[RobotConfig, ...], code: int, message: str) -> None:
    """Check that a team is refused and nothing is written."""
    given = tmp_path / "given.yaml"
    config = dataclasses.replace(load_team_file(PAIR_TEAM), robots=robots)
    given.write_text(dump_team(config))
    before = sorted(tmp_path.iterdir())
    assert_fails(code, message, "refine", given, "-o", tmp_path / "out.yaml")
    assert sorted(tmp_path.iterdir()) == before


def pair_robots() -> tuple[RobotConfig, ...]:
    """The robots of the fixture, with absolute paths."""
    return tuple(robot.with_absolute_paths() for robot in load_team_file(PAIR_TEAM).robots)


def test_a_pose_file_without_times_in_common_is_refused(tmp_path: Path) -> None:
    poses = tmp_path / "old.tum"
    poses.write_text("1.0 0 0 0 0 0 0 1\n2.0 0 0 0 0 0 0 1\n")
    identity = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    robots = tuple(
        dataclasses.replace(robot, pose_topic=None, pose_file=poses, T_team_map=identity) for robot in pair_robots()
    )
    refused(tmp_path, robots, 1, "no robot has a frame that can be used")


def test_robots_without_frames_that_are_related_are_refused(tmp_path: Path) -> None:
    # A trajectory file names no frame.
    poses = tmp_path / "p.tum"
    robots = tuple(dataclasses.replace(robot, pose_topic=None, pose_file=poses) for robot in pair_robots())
    poses.write_text("1.0 0 0 0 0 0 0 1\n2.0 0 0 0 0 0 0 1\n")
    message = "T_team_map: husky_1, husky_2 have none, and nothing relates their map frames; find it with"
    refused(tmp_path, robots, 2, message)


@pytest.mark.long
def test_a_kitti_file_is_replaced_by_times_and_poses(team: Path, tmp_path: Path) -> None:
    config = load_team_file(team)
    robot = config.robots[0].with_absolute_paths()
    stamps = []
    resolved = resolve(config)
    with RobotLog(resolved.robots[0], config.time, resolved.classes) as log:
        frames = list(log.frames())
    lines = [" ".join(f"{value:.9f}" for value in frame.T_team_sensor[:3].ravel()) for frame in frames]
    stamps = [f"{frame.stamp_ns // 10**9}.{frame.stamp_ns % 10**9:09d}" for frame in frames]
    (tmp_path / "poses.txt").write_text("\n".join(lines) + "\n")
    (tmp_path / "times.txt").write_text("\n".join(stamps) + "\n")
    kitti = dataclasses.replace(
        robot, pose_topic=None, pose_file=tmp_path / "poses.txt", pose_times=tmp_path / "times.txt",
        T_team_map=numbers_of(np.eye(4)),
    )  # fmt: skip
    other = config.robots[1].with_absolute_paths()
    given = tmp_path / "kitti.yaml"
    given.write_text(dump_team(dataclasses.replace(config, robots=(kitti, other))))
    # Images are 0.4 s apart.
    text = given.read_text() + "pose_gap: 0.5\n"
    given.write_text(text)
    done = octoreplay("refine", given, "-o", tmp_path / "out.yaml", *DRIFT)
    assert done.returncode in (0, 3), done.stderr
    new = load_team_file(tmp_path / "out.yaml").robots[0]
    assert (new.pose_file, new.pose_times) == (tmp_path / "out-poses" / "husky_1.tum", None)
    assert len(read_tum_track(new.pose_file).stamps_ns) == len(frames)


def test_wrong_use_is_refused_before_any_work(team: Path, tmp_path: Path) -> None:
    output = tmp_path / "out.yaml"
    copied = tmp_path / "team.yaml"
    shutil.copy(team, copied)
    for code, message, *arguments in (
        (2, "is no team file", PAIR / "husky_1.mcap", "-o", output),
        (2, "must end in .yaml", team, "-o", tmp_path / "out.mcap"),
        (1, "is an input of this command", copied, "-o", copied),
        (2, "drift: expects 2 numbers", team, "-o", output, "--drift", "1"),
        (2, "drift in percent: 0 is not between", team, "-o", output, "--drift", "0,1"),
        (2, "hold_back: 1 is not between", team, "-o", output, "--hold-back", "1"),
        (2, "submap_seconds", team, "-o", output, "--submap-seconds", "0"),
        (1, "holds no husky_1.tum", team, "-o", output, "--truth", tmp_path),
        (2, "must end in .png", team, "-o", output, "--plot", tmp_path / "x.pdf"),
    ):
        assert_fails(code, message, "refine", *arguments)
    output.write_text("mine")
    assert_fails(1, "already exists", "refine", team, "-o", output)
    assert output.read_text() == "mine"
