"""Values of dataclasses from JSON, checked against the types of their fields."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Mapping
from functools import cache
from typing import Any


def value_of(hint: Any, stored: Any) -> Any:
    """Return a JSON value as the type ``hint``: bool, int, float, str, tuple, list, mapping or a dataclass of these.

    Keys of mappings are text in JSON and may be int. Fields of a dataclass that are missing take their defaults, and
    unknown fields are ignored. Raises ValueError for a value of another type.
    """
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if hint is Any:
        return stored
    if dataclasses.is_dataclass(hint):
        return record_of(hint, stored)
    if origin in (tuple, list) and isinstance(stored, list):
        return origin(value_of(arguments[0], entry) for entry in stored)
    if origin in (dict, Mapping) and isinstance(stored, dict):
        return {arguments[0](key): value_of(arguments[1], entry) for key, entry in stored.items()}
    if origin in (typing.Union, types.UnionType):
        return None if stored is None else value_of(arguments[0], stored)
    if hint is float and type(stored) is int:
        return float(stored) if abs(stored) < 1 << 63 else _refuse(hint, stored)
    if type(stored) is not hint or (hint is int and abs(stored) >= 1 << 63):
        _refuse(hint, stored)
    return stored


def record_of(kind: Any, stored: Any) -> Any:
    """Return the dataclass ``kind`` of a JSON object. Raises ValueError as ``value_of``."""
    if not isinstance(stored, dict):
        _refuse(kind, stored)
    hints = _hints(kind)
    missing = [item.name for item in dataclasses.fields(kind) if item.name not in stored and not _has_default(item)]
    if missing:
        raise ValueError(f"'{missing[0]}' is missing")
    values = {name: value_of(hint, stored[name]) for name, hint in hints.items() if name in stored}
    return kind(**values)


@cache
def _hints(kind: Any) -> dict[str, Any]:
    """Types of a dataclass's fields."""
    return typing.get_type_hints(kind)


def _has_default(item: dataclasses.Field[Any]) -> bool:
    """True for a field with a default."""
    return item.default is not dataclasses.MISSING or item.default_factory is not dataclasses.MISSING


def _refuse(hint: Any, stored: Any) -> Any:
    """Raise ValueError for a value of another type."""
    raise ValueError(f"{stored!r:.60} is not of type {getattr(hint, '__name__', hint)}")
