"""Edits of a class table: merging and ignoring of classes."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Mapping, Sequence
from typing import TypeAlias

from octoreplay.errors import ConfigError
from octoreplay.records import ClassTable, SemanticClass

MAX_CLASSES = 254
"""Maximum number of classes: a class_id is one byte, 0 is free space and 255 means no class."""

Merges: TypeAlias = tuple[tuple[str, tuple[str, ...]], ...]
"""New class names, each with the names of the classes that it replaces."""


def edited(table: ClassTable, merge: Merges, ignore: Sequence[str]) -> ClassTable:
    """Return the class table after ``merge`` and then ``ignore``, with new class_ids.

    A merged class takes the position and the colour of its first member, and the raw labels and raw colours of all
    members. Raw labels and raw colours of an ignored class are ignored.

    Raises ConfigError for an unknown name, a class that is merged twice, or a result with no class or more than
    ``MAX_CLASSES``.
    """
    becomes = _destinations(table, merge)
    kept = _merged(table, merge, becomes)
    for name in ignore:
        if name in becomes and name not in kept:
            raise ConfigError(
                f"ignore_hits: merge_classes makes '{name}' part of '{becomes[name]}'; ignore that class, or do not"
                " merge it"
            )
        _check_name("ignore_hits", name, kept)
    ignored = [kept.pop(name) for name in dict.fromkeys(ignore)]
    if not kept:
        raise ConfigError("classes: all classes are ignored; keep at least one")
    if len(kept) > MAX_CLASSES:
        raise ConfigError(
            f"classes: at most {MAX_CLASSES} classes can be mapped, got {len(kept)}; merge some with merge_classes"
        )
    return ClassTable(
        tuple(dataclasses.replace(item, class_id=index + 1) for index, item in enumerate(kept.values())),
        (*table.ignored_raw_labels, *(raw for item in ignored for raw in item.raw_labels)),
        tuple(dict.fromkeys((*table.ignored_raw_colors, *(color for item in ignored for color in item.raw_colors)))),
    )


def _destinations(table: ClassTable, merge: Merges) -> dict[str, str]:
    """New name of each merged class. Raises ConfigError like ``edited``."""
    becomes: dict[str, str] = {}
    for new, names in merge:
        if new in table.names and new not in names:
            raise ConfigError(
                f"merge_classes: '{new}' is already a class of the table; list it among the merged classes or use"
                " another name"
            )
        for name in names:
            _check_name("merge_classes", name, table.names)
            if name in becomes:
                raise ConfigError(
                    f"merge_classes: '{name}' is merged into both '{becomes[name]}' and '{new}'; remove one"
                )
            becomes[name] = new
    return becomes


def _merged(table: ClassTable, merge: Merges, becomes: Mapping[str, str]) -> dict[str, SemanticClass]:
    """Classes by name, with each merged class at the position of its first member."""
    by_name = {item.name: item for item in table.classes}
    merged = {names[0]: _merged_class(new, [by_name[name] for name in names]) for new, names in merge}
    found = (merged.get(item.name, item) for item in table.classes if item.name in merged or item.name not in becomes)
    return {item.name: item for item in found}


def _merged_class(name: str, members: Sequence[SemanticClass]) -> SemanticClass:
    """One class made of several, with the first one's colour."""
    return dataclasses.replace(
        members[0],
        name=name,
        raw_labels=tuple(sorted(raw for item in members for raw in item.raw_labels)),
        raw_colors=tuple(dict.fromkeys(color for item in members for color in item.raw_colors)),
    )


def _check_name(key: str, name: str, known: Sequence[str] | Mapping[str, SemanticClass]) -> None:
    """Check that a class exists. Raises ConfigError that suggests the most similar name."""
    if name in known:
        return
    by_lower = {other.lower(): other for other in known}
    near = difflib.get_close_matches(name.lower(), list(by_lower), n=1)
    remedy = f"did you mean '{by_lower[near[0]]}'?" if near else f"classes: {', '.join(list(known)[:12])}"
    more = ", ..." if not near and len(known) > 12 else ""
    raise ConfigError(f"{key}: no class is called '{name}'; {remedy}{more}")
