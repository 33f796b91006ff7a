"""What a team makes of a class table: classes that become one, and classes that hit nothing."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Mapping, Sequence
from typing import TypeAlias

from octoreplay.errors import ConfigError
from octoreplay.records import ClassTable, SemanticClass

MAX_CLASSES = 254
"""So many classes a map can have: a class_id is a byte, 0 is free and 255 marks what a table does not know."""

Merges: TypeAlias = tuple[tuple[str, tuple[str, ...]], ...]
"""New names, each with the names of the classes that become it."""


def edited(table: ClassTable, merge: Merges, ignore: Sequence[str]) -> ClassTable:
    """A class table after ``merge`` and then ``ignore``, its classes numbered anew.

    A merged class stands where the first of its members stood, with that member's colour; it has the raw labels and
    the colours in images of them all. Raw labels and colours of an ignored class become ignored ones. Raises
    ConfigError for a name that the table does not have, a class with two destinations, or where no class or more than
    ``MAX_CLASSES`` are left.
    """
    becomes = _destinations(table, merge)
    kept = _merged(table, merge, becomes)
    for name in ignore:
        if name in becomes and name not in kept:
            raise ConfigError(
                f"ignore_hits: '{name}' is part of '{becomes[name]}' by merge_classes; name that, or take it out there"
            )
        _check_name("ignore_hits", name, kept)
    ignored = [kept.pop(name) for name in dict.fromkeys(ignore)]
    if not kept:
        raise ConfigError("classes: no class is left to map; a table needs at least one that is not ignored")
    if len(kept) > MAX_CLASSES:
        raise ConfigError(
            f"classes: at most {MAX_CLASSES} classes can be mapped, got {len(kept)}; join some with merge_classes"
        )
    return ClassTable(
        tuple(dataclasses.replace(item, class_id=index + 1) for index, item in enumerate(kept.values())),
        (*table.ignored_raw_labels, *(raw for item in ignored for raw in item.raw_labels)),
        tuple(dict.fromkeys((*table.ignored_raw_colors, *(color for item in ignored for color in item.raw_colors)))),
    )


def _destinations(table: ClassTable, merge: Merges) -> dict[str, str]:
    """The new name of each class that is merged. Raises ConfigError as ``edited`` does."""
    becomes: dict[str, str] = {}
    for new, names in merge:
        if new in table.names and new not in names:
            raise ConfigError(
                f"merge_classes: '{new}' is a class of the table itself; list it among its members or take another name"
            )
        for name in names:
            _check_name("merge_classes", name, table.names)
            if name in becomes:
                raise ConfigError(f"merge_classes: '{name}' becomes both '{becomes[name]}' and '{new}'; take one out")
            becomes[name] = new
    return becomes


def _merged(table: ClassTable, merge: Merges, becomes: Mapping[str, str]) -> dict[str, SemanticClass]:
    """The classes by name, merged ones in the place of their first members."""
    by_name = {item.name: item for item in table.classes}
    joined = {names[0]: _joined(new, [by_name[name] for name in names]) for new, names in merge}
    found = (joined.get(item.name, item) for item in table.classes if item.name in joined or item.name not in becomes)
    return {item.name: item for item in found}


def _joined(name: str, members: Sequence[SemanticClass]) -> SemanticClass:
    """One class from several; the first gives the colour."""
    return dataclasses.replace(
        members[0],
        name=name,
        raw_labels=tuple(sorted(raw for item in members for raw in item.raw_labels)),
        raw_colors=tuple(dict.fromkeys(color for item in members for color in item.raw_colors)),
    )


def _check_name(key: str, name: str, known: Sequence[str] | Mapping[str, SemanticClass]) -> None:
    """Refuse a name that no class has, with the nearest one."""
    if name in known:
        return
    spelt = {other.lower(): other for other in known}
    near = difflib.get_close_matches(name.lower(), list(spelt), n=1)
    remedy = f"did you mean '{spelt[near[0]]}'?" if near else f"classes: {', '.join(list(known)[:12])}"
    more = ", ..." if not near and len(known) > 12 else ""
    raise ConfigError(f"{key}: no class is called '{name}'; {remedy}{more}")
