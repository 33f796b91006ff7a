"""Raw labels to class ids, and class tables from the LabelInfo messages of a team."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from octoreplay.config import PALETTE
from octoreplay.errors import ConfigError, InputError
from octoreplay.records import NO_CLASS, ClassTable, SemanticClass, UInt8Array

UNLABELLED = (255, 65535)
"""Raw labels that are ignored unless the class table names them (8 and 16 bit)."""

UNLABELLED_NAMES = frozenset({"unlabeled", "unlabelled", "unknown", "ignore", "ignored", "void", "invalid"})
"""Class names of a LabelInfo that mean 'no usable label'."""

OCCUPIED = ClassTable((SemanticClass(1, "occupied", PALETTE[0], ()),))
"""The class table of a team without labels: plain occupancy."""

_MAX_CLASSES = 254
# Not a class id, since there are at most 254 classes: marks raw labels that the table does not know.
_UNKNOWN = 255
_LUT_SIZE = 1 << 16


class LabelLookup:
    """Raw labels to class ids by a class table; counts the raw labels that the table does not know."""

    def __init__(self, table: ClassTable, *, strict: bool = False) -> None:
        self._strict = strict
        self._meaning = dict.fromkeys((*UNLABELLED, *table.ignored_raw_labels), NO_CLASS)
        # A raw -1 is how a signed image writes 65535.
        self._meaning[-1] = NO_CLASS
        for semantic_class in table.classes:
            self._meaning.update(dict.fromkeys(semantic_class.raw_labels, semantic_class.class_id))
        self._lut = np.full(_LUT_SIZE, _UNKNOWN, dtype=np.uint8)
        for raw, class_id in self._meaning.items():
            if 0 <= raw < _LUT_SIZE:
                self._lut[raw] = class_id
        self._bytes = self._lut[:256].tobytes()
        self.unknown: dict[int, int] = {}

    def class_ids(self, raw: npt.NDArray[Any], where: str) -> UInt8Array:
        """The class ids of raw labels, an array of the same shape: 1..C, or NO_CLASS where ignored or unknown.

        ``raw`` holds integers of any type. Unknown ones are counted in ``unknown`` (raw label to number).
        Raises InputError for an unknown label where the lookup is strict; ``where`` begins it.
        """
        if raw.dtype == np.uint8:
            # bytearray.translate is several times faster than numpy's indexing, and its result can be written to.
            mapped = np.frombuffer(bytearray(np.ascontiguousarray(raw)).translate(self._bytes), dtype=np.uint8)
            class_ids = mapped.reshape(raw.shape)
        elif raw.dtype == np.uint16:
            class_ids = self._lut.take(raw)
        else:
            class_ids = self._of_any_integer(raw)
        if class_ids.size and class_ids.max() == _UNKNOWN:
            self._count_unknown(raw, class_ids, where)
        return class_ids

    def _of_any_integer(self, raw: npt.NDArray[Any]) -> UInt8Array:
        """Class ids of signed or wide integers, which may lie outside the table."""
        if raw.size and raw.min() >= 0 and raw.max() < _LUT_SIZE:
            return self._lut.take(raw)
        values, inverse = np.unique(raw, return_inverse=True)
        of_value = np.array([self._meaning.get(int(value), _UNKNOWN) for value in values], dtype=np.uint8)
        return of_value.take(inverse).reshape(raw.shape)

    def _count_unknown(self, raw: npt.NDArray[Any], class_ids: UInt8Array, where: str) -> None:
        """Count the unknown raw labels and give them no class."""
        is_unknown = class_ids == _UNKNOWN
        values, counts = np.unique(raw[is_unknown], return_counts=True)
        if self._strict:
            raise InputError(
                f"{where}: raw label {int(values[0])} is not in the class table; "
                f"add it to 'classes' or to 'ignored_raw_labels'"
            )
        for value, count in zip(values.tolist(), counts.tolist(), strict=True):
            self.unknown[value] = self.unknown.get(value, 0) + count
        class_ids[is_unknown] = NO_CLASS


def label_names(info: Any) -> dict[int, str]:
    """Raw label to class name of a vision_msgs/LabelInfo."""
    return {int(entry.class_id): str(entry.class_name) for entry in info.class_map}


def class_table_from_names(names_of_robots: Mapping[str, Mapping[int, str]]) -> ClassTable:
    """The class table of a team from each robot's raw label names: classes are united by name.

    Classes are numbered in the order in which the robots, and in each the raw labels, name them first. Names such as
    'unlabeled', and the raw labels 255 and 65535, are ignored. Raises ConfigError where robots give one raw label two
    names, where nothing is named, or where there are too many classes.
    """
    meaning: dict[int, tuple[str, str]] = {}
    raw_labels: dict[str, list[int]] = {}
    ignored: set[int] = set()
    for robot_id, names in names_of_robots.items():
        for raw, name in sorted(names.items()):
            if raw in UNLABELLED or name.strip().lower() in UNLABELLED_NAMES:
                ignored.add(raw)
                continue
            first_robot, first_name = meaning.setdefault(raw, (robot_id, name))
            if first_name != name:
                raise ConfigError(
                    f"raw label {raw} is '{first_name}' for robot '{first_robot}' and '{name}' for robot '{robot_id}'; "
                    f"give one class table under 'classes' in the team file"
                )
            if raw not in raw_labels.setdefault(name, []):
                raw_labels[name].append(raw)
    clash = sorted(ignored & meaning.keys())
    if clash:
        raise ConfigError(
            f"raw label {clash[0]} is '{meaning[clash[0]][1]}' for robot '{meaning[clash[0]][0]}' and unlabelled for "
            f"another; give one class table under 'classes' in the team file"
        )
    if not 1 <= len(raw_labels) <= _MAX_CLASSES:
        raise ConfigError(
            f"the logs' LabelInfo names {len(raw_labels)} classes; between 1 and {_MAX_CLASSES} are needed"
        )
    return ClassTable(
        tuple(
            SemanticClass(index + 1, name, PALETTE[index % len(PALETTE)], tuple(sorted(raws)))
            for index, (name, raws) in enumerate(raw_labels.items())
        ),
        tuple(sorted(ignored)),
    )
