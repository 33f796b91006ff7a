"""Fields of configuration dataclasses: help texts, ranges and the checks against them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import field
from typing import Any

from octoreplay.errors import ConfigError

LARGEST, SMALLEST = 1e12, 1e-15
"""Limits of all numbers; SMALLEST applies to numbers above 0. They keep nanosecond times within int64."""


def parameter(
    default: Any,
    help_text: str,
    *,
    minimum: float | None = None,
    maximum: float | None = None,
    above: float | None = None,
    choices: tuple[str, ...] | None = None,
) -> Any:
    """Dataclass field of a parameter, with its help text, range (inclusive, or ``above`` a number) and choices."""
    return field(
        default=default,
        metadata={"help": help_text, "minimum": minimum, "maximum": maximum, "above": above, "choices": choices},
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
            raise ConfigError(f"{item.name}: '{value}' is not one of {', '.join(meta['choices'])}")
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
