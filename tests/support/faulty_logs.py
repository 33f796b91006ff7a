"""Six logs with one fault each, of robots that drive along x for 200 s with an image every four seconds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from support.log_damage import mcap_chunks
from support.log_factory import SECOND, Entry, depth_pixels, label_pixels, robot_entries, ros2, write_mcap
from support.read_logs import DEPTH, LABELS

START = 1000 * SECOND
NUM_IMAGES = 51
PERIOD = 4


def intact_entries(num_images: int = NUM_IMAGES) -> list[Entry]:
    """Messages of the robot without a fault; image i has the stamp START + 4 i s."""
    return robot_entries(num_frames=num_images, period_ns=PERIOD * SECOND, start_ns=START)


def seconds(entry: Entry) -> float:
    """Log time of an entry since START [s]."""
    return (entry.log_time_ns - START) / SECOND


def write_cut(path: Path) -> None:
    """Log that is cut in the middle."""
    write_mcap(path, intact_entries(), chunk_size=3000)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def write_with_damaged_chunks(path: Path) -> None:
    """Log with four damaged chunks in a row and one more."""
    write_mcap(path, intact_entries(), chunk_size=3000)
    data = bytearray(path.read_bytes())
    chunks = mcap_chunks(bytes(data))
    for index in (3, 4, 5, 6, 12):
        data[chunks[index].end - 20] ^= 1
    path.write_bytes(data)


def write_with_a_jump_back(path: Path) -> None:
    """Log whose clock is 60 s behind from 100 s to 148 s: images, labels and poses have old stamps."""
    write_mcap(path, [_set_back(entry) if 100 <= seconds(entry) < 148 else entry for entry in intact_entries()])


def _set_back(entry: Entry) -> Entry:
    """The message with a stamp 60 s before its log time; messages without a stamp that matters stay."""
    stamp_ns, index = entry.log_time_ns - 60 * SECOND, round(seconds(entry) / PERIOD)
    if entry.topic == DEPTH:
        return entry._replace(value=ros2.image(stamp_ns, depth_pixels(index), "16UC1", frame_id="camera"))
    if entry.topic == LABELS:
        return entry._replace(value=ros2.image(stamp_ns, label_pixels(index), "mono8", frame_id="camera"))
    if entry.topic == "/odom":
        return entry._replace(value=ros2.odometry(stamp_ns, (seconds(entry), 0, 0)))
    return entry


def write_late_start(path: Path) -> None:
    """Log that starts 100 s after the others."""
    write_mcap(path, [entry for entry in intact_entries() if seconds(entry) >= 100 or entry.topic == "/tf_static"])


def write_with_a_pose_gap(path: Path) -> None:
    """Log without poses between 48 s and 108 s."""
    write_mcap(path, [e for e in intact_entries() if e.topic != "/odom" or not 48 < seconds(e) < 108])


def write_shuffled(path: Path) -> None:
    """Log whose messages come in random order within blocks of 40 messages, which last 26 s."""
    entries, rng = intact_entries(), np.random.default_rng(7)
    order = np.concatenate(
        [start + rng.permutation(min(40, len(entries) - start)) for start in range(0, len(entries), 40)]
    )
    pairs = zip(entries, (entries[index] for index in order), strict=True)
    write_mcap(path, [moved._replace(log_time_ns=place.log_time_ns) for place, moved in pairs])


FAULTS: dict[str, Callable[[Path], None]] = {
    "cut": write_cut,
    "damaged": write_with_damaged_chunks,
    "set_back": write_with_a_jump_back,
    "late": write_late_start,
    "pose_gap": write_with_a_pose_gap,
    "shuffled": write_shuffled,
}


def write_without(path: Path, used_ns: Sequence[int]) -> None:
    """Intact log with the images of some stamps only."""
    stamps = set(used_ns)
    write_mcap(path, [e for e in intact_entries() if e.topic != DEPTH or e.log_time_ns in stamps])


def write_team(folder: Path) -> Path:
    """Team file of all logs in a folder, one robot each, all in one map frame."""
    robots = "\n".join(f"  - {{id: {path.stem}, log: {path.name}}}" for path in sorted(folder.glob("*.mcap")))
    (folder / "team.yaml").write_text(
        f"robots:\n{robots}\npose_gap: 2.1\nrule: local\nsettle: 0\npublish_period: 25\nresolution: 0.5\n"
    )
    return folder / "team.yaml"
