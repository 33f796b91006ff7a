"""Class tables in team files and class files."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from octoreplay.config.class_tables.edits import Merges, edited
from octoreplay.config.class_tables.label_rows import BUILT_IN, built_in_rows, hydra_rows, kimera_rows, table_of_rows
from octoreplay.config.class_tables.palette import PALETTE
from octoreplay.config.fields import is_number, path_problem
from octoreplay.config.run import RunConfig
from octoreplay.config.yaml_file import load_yaml, read_text
from octoreplay.errors import ConfigError, suggestion
from octoreplay.records import ClassTable, Color, SemanticClass

CLASSES_KEYS = ("classes", "ignored_raw_labels", "ignored_raw_colors", "merge_classes", "ignore_hits")
_CLASS_KEYS = ("name", "color", "raw_labels", "raw_colors")


def with_classes(config: RunConfig, name: str) -> RunConfig:
    """Return a configuration with the classes of a built-in table or a file instead of its own.

    A file without 'classes' edits the configuration's own classes, or those of the logs. Raises ConfigError that names
    the file for an unknown key or a wrong value.
    """
    settings = _named_classes(name, Path())
    if "classes" not in settings and config.classes is not None:
        settings = {"classes": edited(config.classes, settings["merge_classes"], settings["ignore_hits"])}
    return dataclasses.replace(config, **{"merge_classes": (), "ignore_hits": (), **settings})


def named_class_table(name: str) -> ClassTable:
    """Return the class table of a built-in name or a file. Raises ConfigError, also for a file without 'classes'."""
    table: ClassTable | None = _named_classes(name, Path()).get("classes")
    if table is None:
        raise ConfigError(f"{name}: the file has no key 'classes'")
    return table


def class_settings(content: Mapping[str, Any], folder: Path, files: tuple[Path, ...] = ()) -> dict[str, Any]:
    """Return the fields of RunConfig that a mapping sets: ``classes``, or the edits of the logs' own classes.

    ``files`` are the files whose 'classes' led to this mapping. Raises ConfigError.
    """
    merge, ignore = _merges(content.get("merge_classes") or {}), _names("ignore_hits", content.get("ignore_hits") or ())
    entries = content.get("classes")
    if entries is None:
        for key in ("ignored_raw_labels", "ignored_raw_colors"):
            if content.get(key):
                raise ConfigError(
                    f"{key}: needs 'classes'; to ignore some of the logs' own classes, list them in ignore_hits"
                )
        return {"merge_classes": merge, "ignore_hits": ignore}
    if isinstance(entries, str):
        table = _named_classes(entries, folder, files).get("classes")
        if table is None:
            raise ConfigError(f"classes: the file '{entries}' has no key 'classes'")
    else:
        table = class_table(entries)
    table = _ignoring(table, content.get("ignored_raw_labels") or (), content.get("ignored_raw_colors") or ())
    return {"classes": edited(table, merge, ignore)}


def _named_classes(name: str, folder: Path, files: tuple[Path, ...] = ()) -> dict[str, Any]:
    """Class settings of a built-in table or a file; ``files`` are the files that led to it."""
    if name in BUILT_IN:
        return {"classes": table_of_rows(built_in_rows(name), PALETTE)}
    path = folder / name
    if path_problem(path) is not None or not path.is_file():
        near = suggestion(name.lower(), BUILT_IN)
        raise ConfigError(f"classes: '{name}' is neither a file nor a built-in table ({', '.join(BUILT_IN)}){near}")
    if path.resolve() in files:
        raise ConfigError(f"classes: the file '{name}' refers to itself")
    text = read_text(path, "class")
    content = None if path.suffix.lower() == ".csv" else load_yaml(text, str(path))
    try:
        if path.suffix.lower() == ".csv":
            return {"classes": edited(table_of_rows(kimera_rows(text), PALETTE), (), ())}
        if isinstance(content, Mapping) and "label_names" in content:
            return {"classes": edited(table_of_rows(hydra_rows(content), PALETTE), (), ())}
        content = {"classes": content} if isinstance(content, list) else content
        if isinstance(content, Mapping) and "robots" in content:
            # A team file: only its class settings are used.
            content = {key: value for key, value in content.items() if key in CLASSES_KEYS}
            if not content:
                raise ConfigError("the team file has no class settings")
        if not isinstance(content, Mapping):
            raise ConfigError("a class file is a list of classes, or a mapping with 'classes'")
        for key in content:
            if key not in CLASSES_KEYS:
                raise ConfigError(f"{key}: unknown key{suggestion(str(key), CLASSES_KEYS)}")
        return class_settings(content, path.parent, (*files, path.resolve()))
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


def _merges(entries: Any) -> Merges:
    """Merged classes from a mapping of new names to lists of class names."""
    if not isinstance(entries, Mapping):
        raise ConfigError("merge_classes: expects new names, each with a list of classes, such as vehicle: [car, bus]")
    merges = tuple((str(new), _names("merge_classes", names)) for new, names in entries.items())
    for new, names in merges:
        if not names:
            raise ConfigError(f"merge_classes: '{new}' needs at least one class")
    return merges


def _names(key: str, value: Any) -> tuple[str, ...]:
    """Class names from a list or a single name."""
    names = [value] if isinstance(value, str) else value
    if not isinstance(names, list | tuple) or not all(isinstance(name, str | int) for name in names):
        raise ConfigError(f"{key}: expects a list of class names, got {value!r}")
    return tuple(str(name) for name in names)


def class_table(entries: Any, ignored: Any = ()) -> ClassTable:
    """Return the class table of a list of mappings with name, color [r, g, b], raw_labels and raw_colors.

    ``ignored`` are further raw labels to ignore. Raises ConfigError for an unknown key, a wrong type, a repeated name
    or a raw label of two classes.
    """
    if not isinstance(entries, list | tuple) or not entries:
        raise ConfigError(
            f"classes: expects a list of classes, each with 'name' and 'raw_labels', or one of {', '.join(BUILT_IN)}"
        )
    classes: list[SemanticClass] = []
    meaning: dict[int, str] = {}
    for index, entry in enumerate(entries):
        if not isinstance(entry, Mapping) or "name" not in entry:
            raise ConfigError("classes: every class is a mapping with 'name', 'color', 'raw_labels' and 'raw_colors'")
        for key in entry:
            if key not in _CLASS_KEYS:
                raise ConfigError(f"classes: {key}: unknown key{suggestion(str(key), _CLASS_KEYS)}")
        name = str(entry["name"])
        if any(item.name == name for item in classes):
            raise ConfigError(f"classes: '{name}' is listed twice; list all its raw_labels in one entry")
        if name == "free":
            raise ConfigError("classes: 'free' is the name of free space, which is not a class; rename the class")
        raw_labels = _raw_labels(entry.get("raw_labels", [index + 1]), name)
        for raw in raw_labels:
            if raw in meaning:
                raise ConfigError(f"classes: raw label {raw} belongs to both '{meaning[raw]}' and '{name}'")
            meaning[raw] = name
        given = entry.get("color")
        color = _color(given or PALETTE[index % len(PALETTE)], f"the color of '{name}'")
        # A colour of the palette does not occur in label images.
        raw_colors: Any = entry.get("raw_colors", [color] if given else [])
        classes.append(SemanticClass(index + 1, name, color, raw_labels, _colors(raw_colors, f"'{name}'")))
    return _ignoring(ClassTable(tuple(classes)), ignored, ())


def _ignoring(table: ClassTable, labels: Any, colors: Any) -> ClassTable:
    """Class table with additional raw labels and colours to ignore."""
    ignored = _raw_labels(labels, "ignored_raw_labels")
    meaning = {raw: item.name for item in table.classes for raw in item.raw_labels}
    for raw in ignored:
        if raw in meaning:
            raise ConfigError(
                f"classes: raw label {raw} belongs to '{meaning[raw]}' and is listed in ignored_raw_labels"
            )
    return ClassTable(
        table.classes,
        tuple(dict.fromkeys((*table.ignored_raw_labels, *ignored))),
        tuple(dict.fromkeys((*table.ignored_raw_colors, *_colors(colors, "ignored_raw_colors")))),
    )


def _raw_labels(value: Any, name: str) -> tuple[int, ...]:
    """Raw labels from a number or a list."""
    values = [value] if is_number(value) else value
    if not isinstance(values, list | tuple) or not all(isinstance(v, int) and not isinstance(v, bool) for v in values):
        raise ConfigError(f"classes: the raw labels of '{name}' must be whole numbers")
    return tuple(values)


def _color(value: Any, subject: str) -> Color:
    """Colour from a list [r, g, b]."""
    is_color = isinstance(value, list | tuple) and len(value) == 3
    if not is_color or not all(type(part) is int and 0 <= part <= 255 for part in value):
        raise ConfigError(f"classes: {subject} must be three whole numbers from 0 to 255, got {value!r}")
    return value[0], value[1], value[2]


def _colors(values: Any, name: str) -> tuple[Color, ...]:
    """Distinct colours from a list of lists [r, g, b]."""
    if not isinstance(values, list | tuple):
        raise ConfigError(f"classes: the raw colors of {name} must be a list of [r, g, b]")
    return tuple(dict.fromkeys(_color(value, f"every raw color of {name}") for value in values))


def class_to_mapping(item: SemanticClass) -> dict[str, Any]:
    """Return the content of one class in a team file."""
    entry: dict[str, Any] = {"name": item.name, "color": list(item.color), "raw_labels": list(item.raw_labels)}
    if item.raw_colors != (item.color,):
        entry["raw_colors"] = [list(color) for color in item.raw_colors]
    return entry
