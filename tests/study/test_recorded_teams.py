"""Teams of recordings: their parts, their frames, and an experiment on real images from beginning to end."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from PIL import Image

from octoreplay.config.team_file import load_team_file
from octoreplay.errors import InputError
from octoreplay.io.robots.discover import resolve
from octoreplay.io.robots.robot_log import RobotLog
from octoreplay.records import Float64Array
from octoreplay.study import recorded_teams
from octoreplay.study.recorded_teams import Part, RecordedTeam, recorded_parts
from octoreplay.study.team_frames import ALIGNED, MAX_SHIFT, RIGHT, UNALIGNED, frame_errors
from support.command_line import assert_fails, octoreplay_process
from support.long_suite import examples
from support.poses import pose
from support.recordings import RECORDINGS, needs_recordings


def recording(folder: Path, num_images: int) -> Path:
    """A 7-Scenes folder of small images of a wall 1 m away."""
    folder.mkdir(parents=True)
    for index in range(num_images):
        Image.fromarray(np.full((4, 6), 1000, np.uint16)).save(folder / f"frame-{index:06d}.depth.png")
        np.savetxt(folder / f"frame-{index:06d}.pose.txt", pose(index))
    (folder / "camera-intrinsics.txt").write_text("4 0 2.5\n0 4 1.5\n0 0 1\n")
    return folder


def numbers(part: Part) -> list[int]:
    """Numbers of a part's images."""
    return list(range(part.first, part.last + 1, part.every))


@examples(200)
@example(num_images=291, num_robots=2, overlap=0.0)
@given(
    num_images=st.integers(64, 3000),
    num_robots=st.integers(2, 4),
    overlap=st.sampled_from((0.0, 0.25, 0.5)),
)
def test_a_split_gives_each_image_to_one_robot_at_most(num_images: int, num_robots: int, overlap: float) -> None:
    parts = list(recorded_teams._split(Path("room"), num_images, num_robots, overlap))
    chosen = [numbers(part) for part in parts]
    assert len(chosen) == num_robots
    assert len({number for own in chosen for number in own}) == sum(map(len, chosen))
    assert min(map(len, chosen)) >= 3
    assert min(map(min, chosen)) >= 0
    assert max(map(max, chosen)) < num_images
    assert all(4 <= part.every <= max(4, num_images // 50) for part in parts)
    # The parts have one length, together they cover the recording, and neighbours overlap by the share.
    length = num_images / (num_robots - (num_robots - 1) * overlap)
    for index, part in enumerate(parts):
        assert part.first == pytest.approx(index * (1 - overlap) * length, abs=part.every)
        assert part.last + 1 == pytest.approx(part.first + length, abs=part.every + 1)


def test_recordings_give_teams(tmp_path: Path) -> None:
    single = recording(tmp_path / "room", 64)
    scene = tmp_path / "scene"
    for name, num_images in (("seq-01", 3), ("seq-02", 110)):
        recording(scene / name, num_images)
    *split, whole = recorded_parts([single, scene])
    assert [len(parts) for parts in split] == [2, 2, 2, 3, 3, 3, 4, 4, 4]
    assert len(set(split)) == 9
    assert whole == (Part(scene / "seq-01", 0, 2, 1), Part(scene / "seq-02", 0, 109, 2))


def test_a_short_recording_and_a_folder_without_one_are_refused(tmp_path: Path) -> None:
    short = recording(tmp_path / "short", 63)
    with pytest.raises(InputError, match=r"short: has 63 depth images, fewer than the 64 .*; name a longer sequence"):
        list(recorded_parts([short]))
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="empty: no RGB-D sequence found"):
        list(recorded_parts([tmp_path / "empty"]))


def test_the_command_names_a_folder_without_recordings(tmp_path: Path) -> None:
    empty, folder = tmp_path / "empty", tmp_path / "out"
    empty.mkdir()
    assert_fails(1, "empty: no RGB-D sequence found", "experiment", "real", folder, "--data", empty)
    assert_fails(1, "none: is not a folder", "experiment", "real", folder, "--data", tmp_path / "none")
    assert_fails(2, "Missing option '--data'", "experiment", "real", folder)
    assert not folder.exists()


def sensor_poses(team_file: Path) -> dict[str, Float64Array]:
    """Poses (n, 4, 4) of the sensor of each robot in the team's frame."""
    config = resolve(load_team_file(team_file))
    found = {}
    for robot in config.robots:
        with RobotLog(robot, config.time, config.classes) as log:
            found[robot.robot_id] = np.array([frame.T_team_sensor for frame in log.frames()])
    return found


def test_right_frames_give_the_recordings_poses_and_own_frames_do_not(tmp_path: Path) -> None:
    folder = recording(tmp_path / "room", 64)
    parts = (Part(folder, 0, 30, 4), Part(folder, 21, 63, 4))
    team, logs = RecordedTeam(parts, RIGHT, 3), tmp_path / "logs"
    shares: list[float] = []
    team.write(logs, shares.append)
    assert shares[-1] == 1.0
    right, own = sensor_poses(logs / "right.yaml"), sensor_poses(logs / "unaligned.yaml")
    for part, robot_id in zip(parts, ("robot_1", "robot_2"), strict=True):
        true = np.array([pose(number) for number in numbers(part)])
        np.testing.assert_allclose(right[robot_id], true, atol=1e-7)
        # The own frame is turned about z and shifted, the same for all poses.
        T = own[robot_id] @ np.linalg.inv(true)
        np.testing.assert_allclose(T, np.broadcast_to(T[0], T.shape), atol=1e-7)
        np.testing.assert_allclose(T[0, 2, :3], [0.0, 0.0, 1.0], atol=1e-7)
        assert 0.0 < abs(T[0, :3, 3]).max() <= MAX_SHIFT
    first, second = (own[robot_id][0] @ np.linalg.inv(right[robot_id][0]) for robot_id in own)
    assert not np.allclose(first, second, atol=0.01)

    right_config, own_config = (load_team_file(logs / f"{name}.yaml") for name in (RIGHT, UNALIGNED))
    assert frame_errors(right_config, right_config) == pytest.approx((0.0, 0.0), abs=1e-5)
    shift, angle = frame_errors(right_config, own_config)
    error = second @ np.linalg.inv(first)
    assert shift == pytest.approx(np.linalg.norm(error[:3, 3]), abs=1e-6)
    assert np.degrees(np.arccos(error[0, 0])) == pytest.approx(angle, abs=1e-4)

    assert [team.team_file("a", logs), RecordedTeam(parts, UNALIGNED, 3).team_file("b", logs)] == [
        logs / "right.yaml", logs / "unaligned.yaml",
    ]  # fmt: skip
    # A wall fixes no pose, so the robots are not connected.
    assert RecordedTeam(parts, ALIGNED, 3).team_file("c", logs) is None
    before = {path.name: path.stat().st_mtime_ns for path in logs.iterdir()}
    team.write(logs, shares.append)
    assert {path.name: path.stat().st_mtime_ns for path in logs.iterdir()} == before


def test_the_folder_changes_with_the_images(tmp_path: Path) -> None:
    folder = recording(tmp_path / "room", 8)
    parts = (Part(folder, 0, 7, 2), Part(folder, 1, 7, 2))
    team = RecordedTeam(parts, RIGHT, 0)
    assert team.folder_name == RecordedTeam(parts, ALIGNED, 0).folder_name
    assert team.folder_name != RecordedTeam(parts, RIGHT, 1).folder_name
    before = team.folder_name
    Image.fromarray(np.full((8, 12), 900, np.uint16)).save(folder / "frame-000003.depth.png")
    assert team.folder_name != before


@pytest.mark.long
@needs_recordings
def test_four_real_sequences_from_beginning_to_end(tmp_path: Path) -> None:
    stairs = RECORDINGS / "rgbd_seq" / "kapture_7scenes_stairs" / "stairs"
    done = octoreplay_process("experiment", "real", tmp_path / "out", "--data", stairs)
    assert done.returncode == 0, done.stderr
    rows = list(csv.DictReader((tmp_path / "out" / "real.csv").read_text(encoding="utf-8").splitlines()))
    assert [(row["frames"], row["rule"]) for row in rows] == [
        (frames, rule) for frames in (RIGHT, UNALIGNED, ALIGNED) for rule in ("bayes", "flood", "gradient")
    ]
    assert {row["num_recordings"] for row in rows} == {"4"}
    by_frames = {row["frames"]: row for row in rows if row["rule"] == "bayes"}
    assert by_frames[RIGHT]["num_robots"] == by_frames[UNALIGNED]["num_robots"] == "4"
    assert float(by_frames[RIGHT]["frame_shift"]) == pytest.approx(0.0, abs=1e-6)
    assert float(by_frames[ALIGNED]["frame_shift"]) < 0.1 < 1.0 < float(by_frames[UNALIGNED]["frame_shift"])
    # Robots with wrong frames agree as well, on a map with each surface several times.
    assert float(by_frames[UNALIGNED]["agreement_occupied"]) > 0.99
    assert float(by_frames[UNALIGNED]["num_known_cells"]) > 1.2 * float(by_frames[RIGHT]["num_known_cells"])
    assert 0.0 < float(by_frames[RIGHT]["erased"]) < 0.05
    # One robot is left out.
    assert (by_frames[ALIGNED]["num_robots"], by_frames[ALIGNED]["num_recordings"]) == ("3", "4")
    tables = (tmp_path / "out" / "tables.md").read_text(encoding="utf-8")
    assert all(f"| {frames} |" in tables for frames in ("right", "unaligned", "aligned in part"))
    assert (tmp_path / "out" / "figures" / "real.png").is_file()
