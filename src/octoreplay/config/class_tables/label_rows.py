"""Rows of label lists (built-in, Hydra, Kimera-Semantics) and the class tables made from them."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any

from octoreplay.errors import ConfigError
from octoreplay.records import ClassTable, Color, SemanticClass

BUILT_IN = ("semantickitti", "cityscapes", "coco-stuff", "ade20k", "nyu40")
"""Names of the tables that come with octoreplay; docs/classes.md lists their sources."""

UNLABELLED_NAMES = frozenset({"unlabeled", "unlabelled", "unknown", "ignore", "ignored", "void", "invalid"})
"""Names of labels without a class, in lower case."""

_KIMERA_HEADER = "name,red,green,blue,alpha,id"
_KIMERA_UNKNOWN = 0
_WHITE = (255, 255, 255)


@dataclass(frozen=True)
class LabelRow:
    """One raw label with its name, its colour if any, and whether it is ignored; a label may have several rows."""

    raw_label: int
    name: str
    color: Color | None = None
    is_ignored: bool = False


def built_in_rows(name: str) -> tuple[LabelRow, ...]:
    """Return the rows of a built-in table, in the order of their raw labels."""
    text = resources.files(__package__).joinpath(f"{name}.csv").read_text(encoding="utf-8")
    return tuple(
        LabelRow(int(row["id"]), row["name"], _color((row["r"], row["g"], row["b"])), row["ignored"] == "1")
        for row in csv.DictReader(text.splitlines())
    )


def hydra_rows(content: Mapping[str, Any]) -> tuple[LabelRow, ...]:
    """Return the rows of a Hydra label space; its dynamic and invalid labels are ignored.

    Raises ConfigError if the mapping is not a label space.
    """
    entries = content["label_names"]
    if not isinstance(entries, list) or not all(map(_is_named, entries)):
        raise ConfigError("label_names: expects a list of mappings with 'label' and 'name'")
    ignored = {label for key in ("dynamic_labels", "invalid_labels") for label in _whole_numbers(content, key)}
    labels = _whole_numbers({"label_names": [entry["label"] for entry in entries]}, "label_names")
    return tuple(
        LabelRow(label, str(entry["name"]), None, label in ignored)
        for label, entry in zip(labels, entries, strict=True)
    )


def _is_named(entry: Any) -> bool:
    """True for an entry of ``label_names``."""
    return isinstance(entry, Mapping) and "label" in entry and "name" in entry


def _whole_numbers(content: Mapping[str, Any], key: str) -> Sequence[int]:
    """List of labels at a key. Raises ConfigError if it holds anything else than whole numbers."""
    values = content.get(key) or ()
    if not isinstance(values, list | tuple) or not all(type(value) is int for value in values):
        raise ConfigError(f"{key}: expects whole numbers")
    return values


def kimera_rows(text: str) -> tuple[LabelRow, ...]:
    """Return the rows of a Kimera-Semantics palette: CSV with the columns name, red, green, blue, alpha, id.

    The ids are the labels. All objects of one id are one class with the name of the first. Id 0 and white mean
    unknown. Raises ConfigError if the text is not a palette.
    """
    lines = text.splitlines()
    if not lines or lines[0].strip() != _KIMERA_HEADER:
        raise ConfigError(f"a palette begins with the line {_KIMERA_HEADER}")
    names = {_KIMERA_UNKNOWN: "unknown"}
    rows = [LabelRow(_KIMERA_UNKNOWN, names[_KIMERA_UNKNOWN], _WHITE, True)]
    for index, line in enumerate(lines[1:]):
        if not line.strip():
            continue
        # A name may contain commas, quoted or not. Five numbers follow it.
        name, *numbers = line.rsplit(",", 5)
        name, color = name.strip('"'), _color(numbers[:3])
        if color is None or not _is_number(numbers[-1]):
            raise ConfigError(f"line {index + 2}: expects {_KIMERA_HEADER}, got '{line[:80]}'")
        label = int(numbers[-1])
        if label not in names:
            names[label] = f"{name} {label}" if name in names.values() else name
        rows.append(LabelRow(label, names[label], color, label == _KIMERA_UNKNOWN))
    return tuple(rows)


def _is_number(text: str) -> bool:
    """True for a whole number in the range of labels."""
    return text.strip().isdecimal() and len(text) < 20


def _color(texts: Sequence[str]) -> Color | None:
    """Colour from three texts; None unless they are three whole numbers from 0 to 255."""
    if len(texts) != 3 or not all(_is_number(text) and int(text) <= 255 for text in texts):
        return None
    return int(texts[0]), int(texts[1]), int(texts[2])


def table_of_rows(rows: Iterable[LabelRow], palette: Sequence[Color]) -> ClassTable:
    """Return the class table of some rows. Rows of one name are one class; classes are ordered by first occurrence.

    A class without a colour gets one of ``palette`` and no raw colours. A colour shared by a class and an ignored
    label belongs to the class. Raises ConfigError for a raw label with two names.
    """
    rows = tuple(rows)
    names: dict[int, str] = {}
    members: dict[str, list[LabelRow]] = {}
    for row in rows:
        if names.setdefault(row.raw_label, row.name) != row.name:
            raise ConfigError(f"raw label {row.raw_label} belongs to both '{names[row.raw_label]}' and '{row.name}'")
        if not _is_unlabelled(row):
            members.setdefault(row.name, []).append(row)
    classes = tuple(
        _class_of_rows(index + 1, name, found, palette[index % len(palette)])
        for index, (name, found) in enumerate(members.items())
    )
    ignored = [row for row in rows if _is_unlabelled(row)]
    class_colors = {color for item in classes for color in item.raw_colors}
    return ClassTable(
        classes,
        tuple(dict.fromkeys(row.raw_label for row in ignored)),
        tuple(color for color in dict.fromkeys(_colors(ignored)) if color not in class_colors),
    )


def _is_unlabelled(row: LabelRow) -> bool:
    """True if a row's label is ignored, by its flag or its name."""
    return row.is_ignored or row.name.strip().lower() in UNLABELLED_NAMES


def _colors(rows: Iterable[LabelRow]) -> Iterator[Color]:
    """Colours of the rows that have one."""
    return (row.color for row in rows if row.color is not None)


def _class_of_rows(class_id: int, name: str, rows: Sequence[LabelRow], default: Color) -> SemanticClass:
    """Class made of its rows."""
    colors = tuple(dict.fromkeys(_colors(rows)))
    raw_labels = tuple(sorted({row.raw_label for row in rows}))
    return SemanticClass(class_id, name, colors[0] if colors else default, raw_labels, colors)
