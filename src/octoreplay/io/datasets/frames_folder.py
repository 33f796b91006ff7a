"""What every folder of frames needs to become a log: an order, a choice of frames, their times, and the log's name."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

from octoreplay.errors import ConfigError, InputError, OutputError
from octoreplay.io.text_tables import rows, seconds_to_ns

_END_OF_TIME_NS = 2**31 * 1_000_000_000


def natural_order(path: Path) -> tuple[list[tuple[bool, int, str]], str]:
    """Sorts files by the numbers in their names, so that 10 comes after 9."""
    parts = re.findall(r"[0-9]+|[^0-9]+", path.name)
    return [(False, int(part), "") if part[0] in "0123456789" else (True, 0, part) for part in parts], path.name


def check_choice(rate: float | None, times: Path | None, first: int, every: int) -> None:
    """Raise ConfigError for a choice of times or frames that makes no sense whatever the folder holds."""
    if rate is not None and times is not None:
        raise ConfigError("rate and times: give one of them, not both")
    if rate is not None and not 0 < rate <= 1e6:
        raise ConfigError(f"rate: {rate:g} must be greater than 0 and at most 1000000")
    if first < 0:
        raise ConfigError(f"first: {first} is below the least value 0")
    if every < 1:
        raise ConfigError(f"every: {every} is below the least value 1")


def chosen_frames(folder: Path, total: int, first: int, last: int | None, every: int) -> range:
    """The numbers of the frames ``first`` to ``last``, both included, of them each ``every``-th.

    Raises ConfigError where none of the folder's ``total`` frames is among them.
    """
    chosen = range(first, total if last is None else min(last + 1, total), every)
    if not chosen:
        raise ConfigError(f"{folder}: no frame between first {first} and last {last}; the folder has {total}")
    return chosen


def robot_name(robot_id: str | None, output: Path) -> str:
    """The robot's id: the given one, else the log's file name made good for topic names. Raises ConfigError."""
    if robot_id is None:
        name = re.sub(r"[^A-Za-z0-9_]+", "_", output.stem).strip("_") or "robot"
        return f"robot_{name}" if name[0].isdigit() else name
    if not robot_id or "/" in robot_id:
        raise ConfigError(f"robot id '{robot_id}': must not be empty or contain '/'")
    return robot_id


def read_times(path: Path, chosen: range, total: int) -> list[int]:
    """Stamps [ns] of the chosen frames from a text file of seconds: a line for each frame, or for each chosen one.

    Raises InputError where the file has another number of lines or a line is no time.
    """
    stamps = [seconds_to_ns(where, fields[0]) for where, fields in rows(path)]
    if len(stamps) == total:
        return [stamps[k] for k in chosen]
    if len(stamps) == len(chosen):
        return stamps
    raise InputError(
        f"{path}: has {len(stamps)} times; the folder has {total} frames, of which {len(chosen)} are taken"
    )


def frame_stamps(source: Path, own: Sequence[int] | None, rate: float | None, count: int) -> list[int]:
    """Stamps [ns] of ``count`` frames: from 0 on at ``rate`` Hz, or without a rate their own.

    Raises ConfigError where there is neither; InputError, which begins with ``source``, for stamps that do not ascend,
    are negative or reach past what ROS messages hold.
    """
    if rate is None and own is None:
        raise ConfigError(f"{source}: the frames have no times; give a rate or a file of times")
    stamps = [round(k * 1e9 / rate) for k in range(count)] if rate is not None else list(own or ())
    if any(later <= earlier for earlier, later in pairwise(stamps)):
        raise InputError(f"{source}: the frames' times do not ascend")
    if stamps[0] < 0:
        raise InputError(f"{source}: times must not be negative")
    if stamps[-1] >= _END_OF_TIME_NS:
        raise InputError(f"{source}: times must be below 2^31 s, which is all that ROS messages hold")
    return stamps


@contextmanager
def unfinished(output: Path) -> Iterator[Path]:
    """A name to write the log under; it becomes ``output`` at the end, and is removed after any error.

    Raises OutputError in place of an OSError.
    """
    partial = output.with_name(f"{output.stem}.partial.mcap")
    try:
        yield partial
        partial.replace(output)
    except BaseException as error:
        partial.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise OutputError(f"{output}: cannot be written: {error.strerror}") from error
        raise
