"""Replay of six logs with one fault each: every fault is named, and it stays with its robot."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from octoreplay.config.time import TimeConfig
from octoreplay.io.robots.robot_log import RobotLog
from octoreplay.mapping import codec
from octoreplay.result import Result, open_result
from support.command_line import octoreplay
from support.faulty_logs import FAULTS, NUM_IMAGES, intact_entries, write_team, write_without
from support.log_factory import write_mcap
from support.long_suite import long
from support.read_logs import DEPTH, LABELS, TABLE, robot_of

HEALTHY = ("healthy_1", "healthy_2")


@pytest.fixture(scope="module")
def faulty(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Folder of the logs and the result of a team of six faulty robots and two healthy ones; its warnings."""
    folder = tmp_path_factory.mktemp("faulty")
    for name, write in FAULTS.items():
        write(folder / f"{name}.mcap")
    for name, num_images in zip(HEALTHY, (NUM_IMAGES, NUM_IMAGES - 3), strict=True):
        write_mcap(folder / f"{name}.mcap", intact_entries(num_images))
    done = octoreplay("run", write_team(folder), "-o", folder / "result.mcap")
    assert done.returncode == 3, done.stderr
    return folder, done.stderr


def evidence(result: Result, robot_id: str) -> bytes:
    """Own evidence of a robot at the end of a run, as bytes."""
    return codec.encode_packet(result.evidence(robot_id).octree)


def used_stamps(path: Path) -> list[int]:
    """Stamps of the images that a robot's log gives."""
    with RobotLog(robot_of(path), TimeConfig(pose_gap=2.1), TABLE) as log:
        return [frame.stamp_ns for frame in log.frames()]


@long
def test_the_maps_are_those_of_logs_without_the_faulty_parts(faulty: tuple[Path, str], tmp_path: Path) -> None:
    folder, _ = faulty
    for path in folder.glob("*.mcap"):
        if path.stem != "result":
            write_without(tmp_path / path.name, used_stamps(path))
    done = octoreplay("run", write_team(tmp_path), "-o", tmp_path / "result.mcap")
    assert done.returncode == 0, done.stderr
    with open_result(folder / "result.mcap") as with_faults, open_result(tmp_path / "result.mcap") as without:
        for robot_id in (*HEALTHY, *FAULTS):
            assert evidence(with_faults, robot_id) == evidence(without, robot_id), robot_id
            assert with_faults.summary.frame_counts[robot_id].used == without.summary.frame_counts[robot_id].used
        sizes = [len(evidence(with_faults, robot_id)) for robot_id in (*HEALTHY, *FAULTS)]
        # The parts that are left out would have made a difference.
        assert len(set(sizes)) == len(sizes)
        counts = with_faults.summary.frame_counts
        assert [counts[name].used for name in HEALTHY] == [NUM_IMAGES, NUM_IMAGES - 3]


MISSING = "no image or cloud was mapped for"
PART = r"in 1 part of the run: stamps"
SENTENCES = {
    "cut": (
        r"cut\.mcap: cut before its end; everything else is used \(log times 1000\.000 s to 11\d\d\.000 s\)",
        rf"cut: {MISSING} \d\d\.0 s, {PART} 11\d\d\.000 s to 1200\.000 s",
    ),
    "damaged": (
        r"damaged\.mcap: 5 damaged chunks with \d\d messages \(log times 10\d\d\.000 s to 10\d\d\.000 s\) were",
    ),
    "set_back": (
        r"set_back: 12 of the images or clouds were more than .* late \(stamps 1040\.000 s to 1084\.000 s\)",
        rf"set_back: {MISSING} 52\.0 s, {PART} 1096\.000 s to 1148\.000 s",
    ),
    "late": (rf"late: {MISSING} 100\.0 s, {PART} 1000\.000 s to 1100\.000 s",),
    "pose_gap": (
        r"pose_gap: 14 of the images or clouds had no pose: .* \(stamps 1052\.000 s to 1104\.000 s\)",
        rf"pose_gap: {MISSING} 60\.0 s, {PART} 1048\.000 s to 1108\.000 s",
    ),
    "shuffled": (
        r"shuffled: \d+ of the images or clouds were more than .* late \(stamps 10\d\d\.000 s to 11\d\d\.000 s\)",
    ),
}


def test_every_fault_is_named_with_its_number_and_span(faulty: tuple[Path, str]) -> None:
    warnings = [line.removeprefix("warning: ") for line in faulty[1].splitlines() if line.startswith("warning: ")]
    for name, sentences in SENTENCES.items():
        for sentence in sentences:
            assert sum(re.search(sentence, line) is not None for line in warnings) == 1, (name, sentence, warnings)
    assert not [line for line in warnings if "healthy" in line]


def test_every_message_is_accounted_for(faulty: tuple[Path, str]) -> None:
    with open_result(faulty[0] / "result.mcap") as result:
        counts_by_robot = result.summary.frame_counts
    for counts in counts_by_robot.values():
        assert counts.unaccounted == {}
        assert set(counts.messages) == {DEPTH, LABELS, "/odom", "/tf_static", "/camera/depth/camera_info"}
    assert counts_by_robot["healthy_1"].outcomes == {
        DEPTH: {"used": 51}, LABELS: {"used": 51}, "/odom": {"used": 101}, "/tf_static": {"used": 1},
        "/camera/depth/camera_info": {"used": 1, "not_read": 50},
    }  # fmt: skip
    assert counts_by_robot["set_back"].outcomes[DEPTH] == {"used": 39, "late": 12}
    assert counts_by_robot["set_back"].outcomes[LABELS] == {"used": 39, "unpaired": 12}
    assert counts_by_robot["pose_gap"].outcomes[DEPTH] == {"used": 37, "no_pose": 14}
    assert counts_by_robot["pose_gap"].outcomes[LABELS] == {"used": 37, "unmapped": 14}
    shuffled = counts_by_robot["shuffled"].outcomes[DEPTH]
    assert sum(shuffled.values()) == 51
    assert set(shuffled) == {"used", "late", "no_label", "no_pose"}
