"""Layouts of trajectory files: the columns of the time, the position and the rotation.

A header names the columns; without one their number decides. A layout that leaves the order of the quaternion open is
refused. Sources:

- TUM, KITTI: https://github.com/MichaelGrupp/evo/wiki/Formats
- EuRoC: Burri and others 2016, ``state_groundtruth_estimate0/data.csv`` (w first, nanoseconds);
  https://projects.asl.ethz.ch/datasets/doku.php?id=kmavvisualinertialdatasets
- Redwood: http://redwood-data.org/indoor/fileformat.html (camera to world)
- TartanAir: https://github.com/castacks/tartanair_tools/blob/master/data_type.md (NED axes)
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from dataclasses import dataclass

from octoreplay.config.file_url import InputFile
from octoreplay.errors import InputError
from octoreplay.io.text_tables import comments, floats, rows, seconds_to_ns

Rows = list[tuple[str, list[str]]]
"""Rows of a table: where each is, and its words."""

Matrices = list[tuple[str, list[float]]]
"""Place of each matrix, and the 12 numbers of its upper three rows."""


@dataclass(frozen=True)
class Columns:
    """Columns of a table with one pose in each row.

    ``position`` and ``quaternion`` (x, y, z, w) are column numbers; ``time`` is None where rows have no time. With
    ``is_geodetic`` the position is latitude, longitude [degree] and height [m].
    """

    name: str
    time: int | None
    position: tuple[int, int, int]
    quaternion: tuple[int, int, int, int]
    is_geodetic: bool = False


_TUM = Columns("TUM", 0, (1, 2, 3), (4, 5, 6, 7))
_EUROC = Columns("EuRoC", 0, (1, 2, 3), (5, 6, 7, 4))
_OF_FORMAT = {
    "tum": (_TUM, "time x y z qx qy qz qw"),
    "euroc": (_EUROC, "time x y z qw qx qy qz"),
    "geodetic": (Columns("geodetic", 0, (1, 2, 3), (4, 5, 6, 7), True), "time latitude longitude height qx qy qz qw"),
    "tartanair": (Columns("TartanAir", None, (0, 1, 2), (3, 4, 5, 6)), "x y z qx qy qz qw"),
}
MATRIX_FORMATS = ("kitti", "matrices", "redwood")
"""Formats of matrices, without times."""

_TUM_FIRST, _EUROC_FIRST = (f"pose_format: {name} ({_OF_FORMAT[name][1]})" for name in ("tum", "euroc"))
_EUROC_WIDTH = 17
_TIME = re.compile(r"(time|stamp|timestamp|t|ts|sec|secs|seconds)([_.].*)?")
_POSITION = re.compile(r"(?:(?:p|t|pos|position|trans|translation)[a-z_.]*?)?([xyz])")
_QUATERNION = re.compile(r"(?:q|quat|quaternion|ori|orient|orientation|rot|rotation)[a-z_.]*?([xyzw])")
_GEODETIC = (re.compile("lat.*"), re.compile("(lon|lng).*"), re.compile("(alt|height|elev).*"))
# Digits of whole numbers of milliseconds, microseconds and nanoseconds since 1970; seconds have at most ten.
_DIGITS = {13: 1_000_000, 16: 1_000, 19: 1}
_LATEST_NS = 2**32 * 1_000_000_000


def time_to_ns(where: str, text: str) -> int:
    """Return a time [ns]: decimal seconds, or whole milliseconds, microseconds or nanoseconds since 1970.

    A whole number of 13, 16 or 19 digits has the unit of its length. Raises InputError, which begins with ``where``.
    """
    unit_ns = _DIGITS.get(len(text)) if text.isascii() and text.isdigit() else None
    if unit_ns is None:
        return seconds_to_ns(where, text)
    if int(text) * unit_ns > _LATEST_NS:
        raise InputError(f"{where}: '{text}' is not a time since 1970")
    return int(text) * unit_ns


def read_table(path: InputFile) -> tuple[Rows, list[str]]:
    """Return the rows of a trajectory file and the names of its columns, in lower case; no names without a header.

    A header is a first row without any number, or a comment above the first row with a name for each column. Raises
    InputError where the file cannot be read or holds no rows.
    """
    table = list(rows(path))
    names: list[str] = []
    if table and not any(_is_number(word) for word in table[0][1]):
        names = _names(",".join(table[0][1]))
        table = table[1:]
    if not table:
        raise InputError(f"{path}: holds no poses")
    width = len(table[0][1])
    if names and len(names) != width:
        raise InputError(f"{table[0][0]}: expects {len(names)} columns as in the header, got {width}")
    for comment in () if names else comments(path):
        found = _names(comment)
        if len(found) == width:
            names = found
    return table, names


def columns_of(path: InputFile, table: Rows, names: Sequence[str], pose_format: str | None) -> Columns:
    """Return the columns of a table with a position and a quaternion in each row.

    Raises InputError where the rows have different widths, hold no rotation, contradict ``pose_format``, or leave open
    whether w comes first.
    """
    width = len(table[0][1])
    odd = next(((where, len(words)) for where, words in table if len(words) != width), None)
    if odd is not None:
        raise InputError(_other_width(odd[0], width, odd[1]))
    named = _named_columns(names)
    if pose_format is not None:
        columns, order = _OF_FORMAT[pose_format]
        if width < 1 + max(columns.quaternion):
            raise InputError(f"{table[0][0]}: pose_format {pose_format} expects {order}, got {width} numbers")
        if named is not None and named.quaternion != columns.quaternion:
            raise InputError(
                f"{path}: its header names the columns {', '.join(names)}, which are not those of pose_format "
                f"{pose_format} ({order}); remove pose_format"
            )
        return columns
    if named is not None:
        return named
    if width in (3, 4) or (names and _find(names, _POSITION)):
        raise InputError(
            f"{path}: holds positions without rotations, and a scan cannot be placed by its position alone; give a "
            "trajectory with rotations, such as one of an odometry"
        )
    in_ns = _DIGITS.get(len(table[0][1][0])) == 1
    if width == _EUROC_WIDTH and in_ns:
        return _EUROC
    if width == 8 and in_ns:
        raise InputError(
            f"{path}: its times are nanoseconds as in EuRoC's files, and no header tells whether w comes first; give "
            f"{_EUROC_FIRST} or {_TUM_FIRST}"
        )
    if width == 8:
        return _TUM
    raise InputError(
        f"{table[0][0]}: expects 8 numbers (TUM: time x y z qx qy qz qw), 12 (KITTI: the rows of a 3x4 matrix) or 16 "
        f"(a 4x4 matrix) in every row, got {width}; for other layouts name the columns in a header"
    )


def matrices_of(path: InputFile, table: Rows, pose_format: str | None) -> tuple[str, Matrices] | None:
    """Return the format of a table of matrices and their upper three rows; None for a table of other content.

    A row with one matrix has 12 or 16 numbers. Stacked matrices have a row for each of their 3 or 4 rows; in Redwood's
    logs a row of three whole numbers precedes each. Raises InputError where a matrix is not complete.
    """
    widths = [len(words) for _, words in table]
    expected = {"kitti": (12,), "matrices": (12, 16), None: (12, 16)}.get(pose_format, ())
    if widths[0] in expected:
        odd = next(((where, len(words)) for where, words in table if len(words) != widths[0]), None)
        if odd is not None:
            raise InputError(_other_width(odd[0], widths[0], odd[1]))
        name = "KITTI" if widths[0] == 12 else "4x4 matrices"
        return name, [_checked(where, floats(where, words)) for where, words in table]
    is_redwood = pose_format == "redwood" or (widths[0] == 3 and 4 in widths)
    if not is_redwood and (widths[0] != 4 or set(widths) != {4} or pose_format not in (None, "matrices")):
        return None
    if is_redwood and (widths[:5] * (len(table) // 5) != widths or widths[:5] != [3, 4, 4, 4, 4]):
        raise InputError(f"{path}: expects blocks of a row of 3 numbers and 4 rows of 4 numbers (Redwood); it is cut")
    numbers = [(where, floats(where, words)) for where, words in table]
    if is_redwood:
        return "Redwood", [_joined(numbers[k + 1 : k + 5]) for k in range(0, len(numbers), 5)]
    has_last_row = len(numbers) % 4 == 0 and all(row == [0, 0, 0, 1] for _, row in numbers[3::4])
    # A column of times ascends without end, the first column of rotations does not leave [-1, 1].
    is_rotation = len(numbers) % 3 == 0 and all(abs(row[0]) <= 1.001 and abs(row[1]) <= 1.001 for _, row in numbers)
    if not has_last_row and not is_rotation:
        return None
    step = 4 if has_last_row else 3
    return "stacked matrices", [_joined(numbers[k : k + step]) for k in range(0, len(numbers), step)]


def _other_width(where: str, width: int, found: int) -> str:
    """Error for a row with another number of columns than the first."""
    return f"{where}: expects {width} numbers as in the rows before, got {found}"


def _joined(part: Sequence[tuple[str, list[float]]]) -> tuple[str, list[float]]:
    """One matrix of its rows."""
    return _checked(part[0][0], [value for _, row in part for value in row])


def _checked(where: str, numbers: list[float]) -> tuple[str, list[float]]:
    """The first three rows of a matrix, whose fourth row, if there is one, must be 0 0 0 1."""
    if len(numbers) == 16 and numbers[12:] != [0, 0, 0, 1]:
        raise InputError(f"{where}: the last row of a 4x4 pose must be 0 0 0 1; its matrices may be transposed")
    return where, numbers[:12]


def _named_columns(names: Sequence[str]) -> Columns | None:
    """Columns that a header names; None unless it names a position and a quaternion."""
    quaternion = _find(names, _QUATERNION)
    geodetic = [next((k for k, name in enumerate(names) if kind.fullmatch(name)), None) for kind in _GEODETIC]
    position = _find(names, _POSITION)
    if not all(axis in quaternion for axis in "xyzw"):
        return None
    time = next((k for k, name in enumerate(names) if _TIME.fullmatch(name)), None)
    x, y, z, w = (quaternion[axis] for axis in "xyzw")
    latitude, longitude, height = geodetic
    if latitude is not None and longitude is not None and height is not None:
        return Columns("geodetic, by its header", time, (latitude, longitude, height), (x, y, z, w), True)
    if not all(axis in position for axis in "xyz"):
        return None
    found = Columns("by its header", time, (position["x"], position["y"], position["z"]), (x, y, z, w))
    return next((known for known in (_TUM, _EUROC) if dataclasses.replace(known, name=found.name) == found), found)


def _find(names: Sequence[str], pattern: re.Pattern[str]) -> dict[str, int]:
    """Column of each axis, the first where several match."""
    found: dict[str, int] = {}
    for k, name in enumerate(names):
        match = pattern.fullmatch(name)
        if match is not None:
            found.setdefault(match[1], k)
    return found


def _names(line: str) -> list[str]:
    """Names in a header line, in lower case and without units."""
    plain = re.sub(r"\[[^\]]*\]|\([^)]*\)", " ", line.lower().strip().lstrip("#"))
    return [name.strip().replace(" ", "_") for name in (plain.split(",") if "," in plain else plain.split())]


def _is_number(word: str) -> bool:
    """True for a word that is a number, also NaN."""
    try:
        float(word)
    except ValueError:
        return False
    return True
