"""Import of a folder of frames: their order, choice, stamps, the robot's name, and the loop that writes the log."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import TypeVar

from octoreplay.errors import ConfigError, InputError
from octoreplay.io.datasets.pose_files import PoseReader
from octoreplay.io.text_tables import rows, seconds_to_ns
from octoreplay.records import Float64Array

T = TypeVar("T")

_END_OF_TIME_NS = 2**31 * 1_000_000_000


def natural_order(path: Path) -> tuple[list[tuple[bool, int, str]], str]:
    """Return the sort key of a file by the numbers in its name, so that 10 comes after 9."""
    parts = re.findall(r"[0-9]+|[^0-9]+", path.name)
    return [(False, int(part), "") if part[0] in "0123456789" else (True, 0, part) for part in parts], path.name


def last_number(path: Path) -> int | None:
    """Return the last number in the name of a file, or of its folder where its name holds none; None without any."""
    numbers = re.findall(r"[0-9]+", path.stem) or re.findall(r"[0-9]+", path.parent.name)
    return int(numbers[-1]) if numbers else None


def check_choice(rate: float | None, times: Path | None, first: int, every: int) -> None:
    """Raise ConfigError for a choice of times or frames that is invalid for every folder."""
    if rate is not None and times is not None:
        raise ConfigError("rate and times: give one of them, not both")
    if rate is not None and not 0 < rate <= 1e6:
        raise ConfigError(f"rate: {rate:g} must be greater than 0 and at most 1000000")
    if first < 0:
        raise ConfigError(f"first: {first} is below the least value 0")
    if every < 1:
        raise ConfigError(f"every: {every} is below the least value 1")


def check_map_frame(name: str) -> None:
    """Raise ConfigError for a name that TF does not allow for a frame."""
    if not name.strip() or name.startswith("/"):
        raise ConfigError(f"map_frame: '{name}' must not be empty or begin with '/'")


def chosen_frames(folder: Path, total: int, first: int, last: int | None, every: int) -> range:
    """Return the numbers of every ``every``-th frame from ``first`` to ``last`` (included).

    Raises ConfigError where none of the folder's ``total`` frames is chosen.
    """
    if first >= total:
        raise ConfigError(f"{folder}: first {first} is beyond the last frame, {total - 1}")
    if last is not None and last < first:
        raise ConfigError(f"{folder}: last {last} is before first {first}")
    return range(first, total if last is None else min(last + 1, total), every)


def robot_name(robot_id: str | None, output: Path) -> str:
    """Return the given robot id, else the log's file name in characters that topics allow. Raises ConfigError."""
    if robot_id is None:
        name = re.sub(r"[^A-Za-z0-9_]+", "_", output.stem).strip("_") or "robot"
        return f"robot_{name}" if name[0].isdigit() else name
    if not robot_id or "/" in robot_id:
        raise ConfigError(f"robot id '{robot_id}': must not be empty or contain '/'")
    return robot_id


def read_times(path: Path, chosen: range, total: int) -> list[int]:
    """Return the stamps [ns] of the chosen frames from a text file with a time in seconds per line.

    Raises InputError where a line is not a time, and as ``entries_of_chosen`` does.
    """
    stamps = [seconds_to_ns(where, fields[0]) for where, fields in rows(path)]
    return entries_of_chosen(stamps, "times", chosen, total, path)


def entries_of_chosen(entries: Sequence[T], what: str, chosen: range, total: int, path: Path) -> list[T]:
    """Return the chosen frames' entries of a file with one entry per frame of the folder or per chosen frame.

    Raises InputError where the file has another number of entries.
    """
    if len(entries) == total:
        return [entries[k] for k in chosen]
    if len(entries) == len(chosen):
        return list(entries)
    raise InputError(
        f"{path}: has {len(entries)} {what}; the folder has {total} frames, {len(chosen)} of them chosen; give one "
        "line for each, or choose frames with first, last and every"
    )


def files_in(folder: Path) -> list[Path]:
    """Return the files of a folder that are not hidden; none where it does not exist.

    Raises InputError where it cannot be read.
    """
    try:
        return [path for path in folder.iterdir() if path.is_file() and not path.name.startswith(".")]
    except FileNotFoundError:
        return []
    except OSError as error:
        raise InputError(f"{folder}: cannot be read: {error.strerror}") from error


def check_folder(folder: Path) -> None:
    """Raise InputError where a path is not a folder."""
    if not folder.is_dir():
        raise InputError(f"{folder}: is not a folder")


def write_frames(
    stamps: Sequence[int],
    readers: Sequence[PoseReader],
    write: Callable[[int, int, Float64Array], None],
    progress: Callable[[float], None] | None,
) -> int:
    """Call ``write(index, stamp_ns, T_map_sensor)`` for each frame with a pose; return the number without a pose.

    ``progress`` is called after every frame with the finished share, 0 to 1.
    """
    num_without_pose = 0
    for index, (stamp_ns, read_pose) in enumerate(zip(stamps, readers, strict=True)):
        T_map_sensor = read_pose()
        if T_map_sensor is None:
            num_without_pose += 1
        else:
            write(index, stamp_ns, T_map_sensor)
        if progress is not None:
            progress((index + 1) / len(stamps))
    return num_without_pose


def frame_stamps(source: Path, own: Sequence[int] | None, rate: float | None, count: int) -> list[int]:
    """Return the stamps [ns] of ``count`` frames: from 0 at ``rate`` Hz, or without a rate their ``own``.

    Raises ConfigError without both; InputError, which begins with ``source``, for stamps that do not ascend, are
    negative or exceed the range of ROS messages.
    """
    if rate is None and own is None:
        raise ConfigError(f"{source}: the frames have no times; give a rate or a file of times")
    stamps = [round(k * 1e9 / rate) for k in range(count)] if rate is not None else list(own or ())
    if any(later <= earlier for earlier, later in pairwise(stamps)):
        raise InputError(f"{source}: the frames' times do not ascend")
    if stamps[0] < 0:
        raise InputError(f"{source}: times must not be negative")
    if stamps[-1] >= _END_OF_TIME_NS:
        raise InputError(f"{source}: times must be below 2^31 s, the limit of ROS messages")
    return stamps
