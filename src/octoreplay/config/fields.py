"""Fields of configuration dataclasses: help texts, ranges and the checks against them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import field
from pathlib import Path
from typing import Any

from octoreplay.errors import ConfigError, suggestion

LARGEST, SMALLEST = 1e12, 1e-15
"""Limits of all numbers; SMALLEST applies to numbers above 0. They keep nanosecond times within int64."""

MAX_TICKS = 10_000_000
"""Largest number of ticks of one run: a day at 100 Hz is 8.6 million."""


MAX_NAME, MAX_PATH = 255, 4095
"""Longest name of a file or folder, and longest path [byte], as in limits.h of Linux."""


def parameter(
    default: Any,
    help_text: str,
    *,
    minimum: float | None = None,
    maximum: float | None = None,
    above: float | None = None,
    choices: tuple[str, ...] | None = None,
    is_common: bool = False,
) -> Any:
    """Dataclass field of a parameter, with its help text, range (inclusive, or ``above`` a number) and choices.

    The options of ``is_common`` parameters are shown by ``--help``, all by ``--help-all``.
    """
    return field(
        default=default,
        metadata={
            "help": help_text,
            "minimum": minimum,
            "maximum": maximum,
            "above": above,
            "choices": choices,
            "is_common": is_common,
        },
    )


def help_text(text: str) -> Mapping[str, str]:
    """Metadata of a robot's key: the help text for comments in team files."""
    return {"help": text}


def check_ranges(config: Any) -> None:
    """Check the parameters of one section. Raises ConfigError for a value out of range."""
    for item in dataclasses.fields(config):
        value, meta = getattr(config, item.name), item.metadata
        if value is None or not meta:
            continue
        if isinstance(value, float) and not math.isfinite(value):
            raise ConfigError(f"{item.name}: {value} is not a finite number")
        if isinstance(value, float) and abs(value) > LARGEST:
            raise ConfigError(f"{item.name}: {value:g} is above the largest value {LARGEST:g}")
        if meta["choices"] is not None and value not in meta["choices"]:
            near = suggestion(str(value), meta["choices"])
            raise ConfigError(f"{item.name}: '{value}' is not one of {', '.join(meta['choices'])}{near}")
        if meta["minimum"] is not None and value < meta["minimum"]:
            raise ConfigError(f"{item.name}: {value} is below the least value {meta['minimum']:g}")
        if meta["maximum"] is not None and value > meta["maximum"]:
            raise ConfigError(f"{item.name}: {value} is above the largest value {meta['maximum']:g}")
        if meta["above"] is not None and value <= meta["above"]:
            raise ConfigError(f"{item.name}: {value} must be greater than {meta['above']:g}")
        if isinstance(value, float) and meta["above"] == 0.0 and value < SMALLEST:
            raise ConfigError(f"{item.name}: {value:g} is below the least value {SMALLEST:g}")


def transform_problem(name: str, numbers: Sequence[float]) -> str | None:
    """Return what is wrong with a transform x, y, z, qx, qy, qz, qw called ``name``; None if nothing is."""
    if len(numbers) != 7:
        return f"{name} expects 7 numbers x, y, z, qx, qy, qz, qw"
    if not all(math.isfinite(number) for number in numbers):
        return f"{name} must be finite, not {tuple(numbers)}"
    if abs(math.hypot(*numbers[3:]) - 1.0) > 1e-3:
        return f"{name}'s quaternion must have length 1"
    return None


def path_problem(path: Path) -> str | None:
    """Return what is wrong with a path that no file system of Linux can hold, or that is not UTF-8; None if nothing is.

    Results and team files hold paths as UTF-8.
    """
    if "\0" in str(path):
        return "its name has a NUL character; name another file"
    try:
        parts = [part.encode() for part in (str(path), *path.parts)]
    except UnicodeEncodeError:
        return "its name is not UTF-8; rename it"
    if len(parts[0]) > MAX_PATH or max(map(len, parts[1:]), default=0) > MAX_NAME:
        return f"its name is longer than {MAX_NAME} bytes, or its path than {MAX_PATH}; name another file"
    return None


def is_number(value: Any) -> bool:
    """True for int and float, not for bool."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def as_number(value: Any) -> float:
    """Float of a number or its text. Raises TypeError and ValueError."""
    if isinstance(value, str):
        return float(value)
    if not is_number(value):
        raise TypeError
    return float(value)
