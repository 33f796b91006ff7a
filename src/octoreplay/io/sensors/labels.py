"""Class ids of raw labels and colours, and class tables from a team's LabelInfo messages."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from octoreplay.config.class_tables.label_rows import UNLABELLED_NAMES
from octoreplay.config.class_tables.palette import PALETTE
from octoreplay.errors import ConfigError, InputError
from octoreplay.io.sensors.images import LabelImage
from octoreplay.records import NO_CLASS, ClassTable, Color, Int64Array, SemanticClass, UInt8Array

UNLABELLED = (255, 65535)
"""Raw labels that are ignored unless the class table has them (8 and 16 bit)."""

OCCUPIED = ClassTable((SemanticClass(1, "occupied", PALETTE[0], ()),))
"""Class table of a team without labels: plain occupancy."""

LOSSY_DISTANCE = 40
"""Largest Euclidean distance, in steps of 255, of a compressed colour to its colour in the table.

JPEG changes a flat colour by a few steps, and next to an edge by tens; a larger distance is a mixture of colours.
"""

# Marks raw labels that are not in the table; no class id, since there are at most 254 classes.
_UNKNOWN = 255
_LUT_SIZE = 1 << 16
_BLACK = (0, 0, 0)
# Largest number of unknown colours that are counted exactly; a photograph in place of labels would have millions.
_MAX_COUNTED_COLORS = 4096


class LabelLookup:
    """Map from raw labels and colours to class ids by a class table; counts those that are not in the table."""

    def __init__(self, table: ClassTable, *, strict: bool = False) -> None:
        self._table = table
        self._strict = strict
        self._class_of = dict.fromkeys((*UNLABELLED, *table.ignored_raw_labels), NO_CLASS)
        # Signed images store 65535 as -1.
        self._class_of[-1] = NO_CLASS
        for semantic_class in table.classes:
            self._class_of.update(dict.fromkeys(semantic_class.raw_labels, semantic_class.class_id))
        self._lut = np.full(_LUT_SIZE, _UNKNOWN, dtype=np.uint8)
        for raw, class_id in self._class_of.items():
            if 0 <= raw < _LUT_SIZE:
                self._lut[raw] = class_id
        self._bytes = self._lut[:256].tobytes()
        self._color_luts: dict[bool, UInt8Array] = {}
        self.unknown: dict[int, int] = {}
        self.unknown_colors: dict[int, int] = {}

    @property
    def num_classes(self) -> int:
        """Number of classes C."""
        return self._table.num_classes

    def of_image(self, image: LabelImage, where: str) -> UInt8Array:
        """Return the class ids (H, W) of a label image; see ``class_ids`` and ``class_ids_of_colors``."""
        if image.is_color:
            return self.class_ids_of_colors(image.pixels, where, is_lossy=image.is_lossy)
        return self.class_ids(image.pixels, where)

    def of_points(self, raw: Int64Array | UInt8Array, where: str) -> UInt8Array:
        """Return the class ids (P,) of points' raw labels (P,) or colours (P, 3)."""
        return self.class_ids_of_colors(raw, where, is_lossy=False) if raw.ndim == 2 else self.class_ids(raw, where)

    def class_ids(self, raw: npt.NDArray[Any], where: str) -> UInt8Array:
        """Return the class ids of raw labels, uint8 of the same shape: 1..C, or NO_CLASS where ignored or unknown.

        ``raw`` holds integers of any type. Unknown labels are counted in ``unknown`` (raw label to number). Raises
        InputError for an unknown label where the lookup is strict; ``where`` begins the message.
        """
        class_ids: UInt8Array
        if raw.dtype == np.uint8:
            # bytearray.translate is several times faster than numpy's indexing, and its result is writable.
            mapped = np.frombuffer(bytearray(np.ascontiguousarray(raw)).translate(self._bytes), dtype=np.uint8)
            class_ids = mapped.reshape(raw.shape)
        elif raw.dtype == np.uint16:
            class_ids = self._lut.take(raw)
        else:
            class_ids = self._of_any_integer(raw)
        if class_ids.size and class_ids.max() == _UNKNOWN:
            self._count_unknown(raw, class_ids, where)
        return class_ids

    def class_ids_of_colors(self, rgb: npt.NDArray[Any], where: str, *, is_lossy: bool) -> UInt8Array:
        """Return the class ids of colours (..., 3) uint8, uint8 of the leading shape: 1..C, or NO_CLASS.

        With ``is_lossy`` (JPEG) a colour matches a colour of the table within ``LOSSY_DISTANCE`` and within half of
        that colour's distance to its nearest neighbour in the table. Unknown colours are counted in ``unknown_colors``
        (0xRRGGBB to number; many or lossy ones rounded down to multiples of 16). Raises ConfigError where two classes
        share a colour or no class has one, InputError for an unknown colour where the lookup is strict and the image is
        not lossy; ``where`` begins the message.
        """
        if is_lossy not in self._color_luts:
            self._color_luts[is_lossy] = _color_lut(_class_ids_by_color(self._table), is_lossy=is_lossy)
        # A pixel padded to four bytes is read as one number: r + 256 g + 65536 b.
        padded = np.zeros((*rgb.shape[:-1], 4), dtype=np.uint8)
        padded[..., :3] = rgb
        class_ids: UInt8Array = self._color_luts[is_lossy].take(padded.view("<u4")[..., 0])
        if class_ids.size and class_ids.max() == _UNKNOWN:
            self._count_unknown_colors(rgb, class_ids, where, is_lossy=is_lossy)
        return class_ids

    def _count_unknown_colors(
        self, rgb: npt.NDArray[Any], class_ids: UInt8Array, where: str, *, is_lossy: bool
    ) -> None:
        """Count the unknown colours and give them no class."""
        is_unknown = class_ids == _UNKNOWN
        keys = rgb[is_unknown].astype(np.int64) @ np.array([1 << 16, 1 << 8, 1])
        if self._strict and not is_lossy:
            raise InputError(
                f"{where}: colour #{int(keys[0]):06x} is not in the class table; "
                f"add it to a class's 'raw_colors' or to 'ignored_raw_colors'"
            )
        values, counts = np.unique(keys, return_counts=True)
        if is_lossy or len(values) + len(self.unknown_colors) > _MAX_COUNTED_COLORS:
            values = values & 0xF0F0F0
        for value, count in zip(values.tolist(), counts.tolist(), strict=True):
            self.unknown_colors[value] = self.unknown_colors.get(value, 0) + count
        class_ids[is_unknown] = NO_CLASS

    def _of_any_integer(self, raw: npt.NDArray[Any]) -> UInt8Array:
        """Class ids of signed or wide integers, which may be outside the lookup array."""
        if raw.size and raw.min() >= 0 and raw.max() < _LUT_SIZE:
            return self._lut.take(raw)
        values, inverse = np.unique(raw, return_inverse=True)
        of_value = np.array([self._of_integer(int(value)) for value in values], dtype=np.uint8)
        return of_value.take(inverse).reshape(raw.shape)

    def _of_integer(self, value: int) -> int:
        """Class id of one number; bits above the lowest 16 are instance ids (SemanticKITTI)."""
        return self._class_of.get(value, self._class_of.get(value & 0xFFFF, _UNKNOWN) if value > 0xFFFF else _UNKNOWN)

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


def _class_ids_by_color(table: ClassTable) -> dict[Color, int]:
    """Class id of every colour of a table. Raises ConfigError where classes share a colour or none has one."""
    owners: dict[Color, str] = {}
    class_of: dict[Color, int] = {}
    for item in table.classes:
        for color in item.raw_colors:
            if color in owners:
                raise ConfigError(
                    f"the labels are colours, but {_hex(color)} is both '{owners[color]}' and '{item.name}'; join "
                    f"them with merge_classes, or give their raw_colors"
                )
            owners[color], class_of[color] = item.name, item.class_id
    for color in table.ignored_raw_colors:
        if color in owners:
            raise ConfigError(
                f"the labels are colours, but {_hex(color)} is both '{owners[color]}' and ignored; ignore that class "
                f"too, or remove the colour from its raw_colors"
            )
    if not class_of:
        raise ConfigError("the labels are colours, but no class has a colour; give every class its 'raw_colors'")
    return {_BLACK: NO_CLASS, **dict.fromkeys(table.ignored_raw_colors, NO_CLASS), **class_of}


def _hex(color: Color) -> str:
    """A colour as #rrggbb."""
    return "#" + bytes(color).hex()


def _color_lut(class_of: Mapping[Color, int], *, is_lossy: bool) -> UInt8Array:
    """Class id of every possible colour, at index r + 256 g + 65536 b: (2^24,) uint8."""
    colors = np.array(list(class_of), dtype=np.int64)
    cube = np.full((256, 256, 256), _UNKNOWN, dtype=np.uint8)
    for color, class_id in zip(colors, class_of.values(), strict=True):
        if is_lossy:
            _fill_ball(cube, color, _least_square(color, colors), class_id)
        b, g, r = color[::-1]
        cube[b, g, r] = class_id
    return cube.reshape(-1)


def _least_square(color: Int64Array, colors: Int64Array) -> float:
    """Squared distance of a colour to the nearest other one; infinite without another."""
    steps = (colors - color).astype(np.float64)
    squares = np.einsum("ij,ij->i", steps, steps)
    return float(np.min(squares[squares > 0], initial=np.inf))


def _fill_ball(cube: UInt8Array, color: Int64Array, least_square: float, class_id: int) -> None:
    """Set the class id of colours within half of the distance to the nearest other colour; balls do not touch."""
    low, high = np.maximum(color - LOSSY_DISTANCE, 0), np.minimum(color + LOSSY_DISTANCE, 255) + 1
    r, g, b = (np.arange(low[i], high[i]) - color[i] for i in range(3))
    squares = b[:, None, None] ** 2 + g[:, None] ** 2 + r**2
    is_near = (4 * squares < least_square) & (squares <= LOSSY_DISTANCE**2)
    cube[low[2] : high[2], low[1] : high[1], low[0] : high[0]][is_near] = class_id


def class_table_from_names(names_of_robots: Mapping[str, Mapping[int, str]]) -> ClassTable:
    """Return the class table of a team from each robot's raw label names; classes are united by name.

    Classes are numbered in order of their first occurrence, by robot and then by raw label. Names such as 'unlabeled'
    and the raw labels 255 and 65535 are ignored. Colours are taken from a palette and match no colours in images.
    Raises ConfigError where robots give one raw label different names, or where no class is named.
    """
    named: dict[int, tuple[str, str]] = {}
    raw_labels: dict[str, list[int]] = {}
    ignored: set[int] = set()
    for robot_id, names in names_of_robots.items():
        for raw, name in sorted(names.items()):
            if raw in UNLABELLED or name.strip().lower() in UNLABELLED_NAMES:
                ignored.add(raw)
                continue
            first_robot, first_name = named.setdefault(raw, (robot_id, name))
            if first_name != name:
                raise ConfigError(
                    f"raw label {raw} is '{first_name}' for robot '{first_robot}' and '{name}' for robot '{robot_id}'; "
                    f"give one class table under 'classes' in the team file"
                )
            if raw not in raw_labels.setdefault(name, []):
                raw_labels[name].append(raw)
    clash = sorted(ignored & named.keys())
    if clash:
        raise ConfigError(
            f"raw label {clash[0]} is '{named[clash[0]][1]}' for robot '{named[clash[0]][0]}' and unlabelled for "
            f"another; give one class table under 'classes' in the team file"
        )
    if not raw_labels:
        raise ConfigError("the logs' LabelInfo names no class; give 'classes' in the team file")
    return ClassTable(
        tuple(
            SemanticClass(index + 1, name, PALETTE[index % len(PALETTE)], tuple(sorted(raws)), ())
            for index, (name, raws) in enumerate(raw_labels.items())
        ),
        tuple(sorted(ignored)),
    )
