"""PCD files, version 0.7 of the Point Cloud Library: ascii, binary and binary_compressed."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from octoreplay.errors import InputError
from octoreplay.records import Float64Array
from octoreplay.transforms import transform_of

_LONGEST_HEADER = 100
"""Largest number of header lines up to 'DATA'."""
_LONGEST_LINE = 65536
_LARGEST_COUNT = 1000
_FORMATS = {
    ("F", 4): "<f4", ("F", 8): "<f8", ("I", 1): "i1", ("I", 2): "<i2", ("I", 4): "<i4", ("I", 8): "<i8",
    ("U", 1): "u1", ("U", 2): "<u2", ("U", 4): "<u4", ("U", 8): "<u8",
}  # fmt: skip
_REMEDY = "fetch it again or remove it from the folder"


@dataclass(frozen=True)
class _Field:
    """Field of a point: ``count`` numbers of one NumPy format."""

    name: str
    number_format: str
    count: int


@dataclass(frozen=True, eq=False)
class _Header:
    """Header of a file; ``data`` is ascii, binary or binary_compressed."""

    fields: tuple[_Field, ...]
    num_points: int
    viewpoint: tuple[float, ...] | None
    data: str

    @property
    def dtype(self) -> np.dtype[Any]:
        """Layout of one point in binary files; fields are named by their number, since names may repeat."""
        return np.dtype([(str(k), field.number_format, (field.count,)) for k, field in enumerate(self.fields)])


def read_pcd(path: Path) -> tuple[dict[str, npt.NDArray[Any]], int]:
    """Return the fields of a PCD file, (P,) each in the type of the header, and the number of extra columns.

    Rows of an ascii file may have more columns than the header names; these extra columns are not read. Fields of
    several numbers are left out. Raises InputError where the file is damaged or cut.
    """
    try:
        with path.open("rb") as file:
            header = _read_header(file, path)
            data = file.read()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    if header.data == "ascii":
        return _ascii(data, header, path)
    if header.data == "binary":
        return _binary(data, header, path), 0
    return _compressed(data, header, path), 0


def read_viewpoint(path: Path) -> Float64Array | None:
    """Return T_map_sensor (4, 4) of a file's VIEWPOINT (x y z qw qx qy qz); None without a usable one.

    Raises InputError where the header is damaged.
    """
    try:
        with path.open("rb") as file:
            viewpoint = _read_header(file, path).viewpoint
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    if viewpoint is None or not np.isfinite(viewpoint).all():
        return None
    x, y, z, qw, qx, qy, qz = viewpoint
    try:
        return transform_of((x, y, z, qx, qy, qz, qw))
    except ValueError:
        return None


# --- header ----------------------------------------------------------------------------------------------------------


def _read_header(file: BinaryIO, path: Path) -> _Header:
    """Header of a file, which is then positioned at its data."""
    entries: dict[str, list[str]] = {}
    for _ in range(_LONGEST_HEADER):
        words = file.readline(_LONGEST_LINE).decode("ascii", "replace").split("#", 1)[0].split()
        if words:
            entries[words[0].upper()] = words[1:]
        if "DATA" in entries:
            return _header(entries, path)
    raise InputError(f"{path}: is not a PCD file, or is cut: its header has no line 'DATA'; {_REMEDY}")


def _header(entries: dict[str, list[str]], path: Path) -> _Header:
    """Header from the words of its lines."""
    names = entries.get("FIELDS") or entries.get("COLUMNS") or []
    counts = _integers(entries, "COUNT", path) or [1] * len(names)
    sizes, types = _integers(entries, "SIZE", path), entries.get("TYPE", [])
    if not names or not len(names) == len(sizes) == len(types) == len(counts):
        raise InputError(f"{path}: its header's lines FIELDS, SIZE, TYPE and COUNT do not fit together; {_REMEDY}")
    fields = []
    for name, size, kind, count in zip(names, sizes, types, counts, strict=True):
        number_format = _FORMATS.get((kind.upper(), size))
        if number_format is None or not 1 <= count <= _LARGEST_COUNT:
            raise InputError(f"{path}: its field '{name}' has the unknown type {kind} with {count} x {size} bytes")
        fields.append(_Field(name, number_format, count))
    data = " ".join(entries["DATA"]).lower()
    if data not in ("ascii", "binary", "binary_compressed"):
        raise InputError(f"{path}: its data is '{data}'; expects ascii, binary or binary_compressed")
    return _Header(tuple(fields), _num_points(entries, path), _viewpoint(entries, path), data)


def _num_points(entries: dict[str, list[str]], path: Path) -> int:
    """Number of points from POINTS and WIDTH x HEIGHT, which must agree."""
    points = _integers(entries, "POINTS", path)
    size = _integers(entries, "WIDTH", path) + _integers(entries, "HEIGHT", path)
    area = [size[0] * size[1]] if len(size) == 2 else []
    if len(points + area) == 0 or len(set(points + area)) > 1 or min(points + area) < 0:
        raise InputError(f"{path}: its header's lines POINTS, WIDTH and HEIGHT do not fit together; {_REMEDY}")
    return (points + area)[0]


def _viewpoint(entries: dict[str, list[str]], path: Path) -> tuple[float, ...] | None:
    """The seven numbers of VIEWPOINT; None without the line."""
    words = entries.get("VIEWPOINT")
    if words is None:
        return None
    try:
        numbers = tuple(float(word) for word in words)
    except ValueError:
        numbers = ()
    if len(numbers) != 7:
        raise InputError(f"{path}: its VIEWPOINT is '{' '.join(words)}'; expects 7 numbers x y z qw qx qy qz")
    return numbers


def _integers(entries: dict[str, list[str]], name: str, path: Path) -> list[int]:
    """Integers of one line; empty where it is missing."""
    try:
        return [int(word) for word in entries.get(name, [])]
    except ValueError:
        raise InputError(f"{path}: its header's line {name} is '{' '.join(entries[name])}'; expects integers") from None


# --- data ------------------------------------------------------------------------------------------------------------


def _ascii(data: bytes, header: _Header, path: Path) -> tuple[dict[str, npt.NDArray[Any]], int]:
    """Fields of rows of numbers, and the number of extra columns."""
    rows = [line for line in data.decode("ascii", "replace").splitlines() if line.strip()]
    if len(rows) != header.num_points:
        raise InputError(
            f"{path}: is cut or damaged: its header gives {header.num_points} points, but it has {len(rows)} rows;"
            f" {_REMEDY}"
        )
    num_columns = sum(field.count for field in header.fields)
    if not rows:
        return {field.name: np.empty(0, field.number_format) for field in header.fields if field.count == 1}, 0
    try:
        table = np.loadtxt(rows, dtype=np.float64, comments=None, ndmin=2)
    except ValueError:
        raise InputError(f"{path}: is cut or damaged: {_bad_row(rows)}; {_REMEDY}") from None
    if table.shape[1] < num_columns:
        raise InputError(
            f"{path}: its header gives {num_columns} columns, but its rows have {table.shape[1]}; {_REMEDY}"
        )
    columns, first = {}, 0
    for field in header.fields:
        if field.count == 1:
            columns[field.name] = _typed(table[:, first], field.number_format)
        first += field.count
    return columns, table.shape[1] - num_columns


def _bad_row(rows: list[str]) -> str:
    """Clause on the first row that differs from row 1."""
    length = len(rows[0].split())
    for number, row in enumerate(rows, start=1):
        words = row.split()
        if len(words) != length:
            return f"row {number} has {len(words)} columns, the first one {length}"
        try:
            [float(word) for word in words]
        except ValueError:
            return f"row {number} is not numbers: '{row[:60]}'"
    return "its rows are not numbers"


def _typed(values: Float64Array, number_format: str) -> npt.NDArray[Any]:
    """Numbers in the type of their field; float64 where it cannot hold them, such as NaN or -1."""
    kind = np.dtype(number_format)
    with np.errstate(over="ignore", invalid="ignore"):
        typed = values.astype(kind)
    return typed if kind.kind == "f" or np.array_equal(typed, values) else values


def _binary(data: bytes, header: _Header, path: Path) -> dict[str, npt.NDArray[Any]]:
    """Fields of points stored one after another."""
    size = header.dtype.itemsize
    # Less than one point may follow: some writers end the file with a line break.
    if not 0 <= len(data) - header.num_points * size < size:
        raise InputError(
            f"{path}: is cut or damaged: its header gives {header.num_points} points of {size} bytes, but it holds "
            f"{len(data)} bytes of data; {_REMEDY}"
        )
    points = np.frombuffer(data, header.dtype, header.num_points)
    return {field.name: points[str(k)][:, 0] for k, field in enumerate(header.fields) if field.count == 1}


def _compressed(data: bytes, header: _Header, path: Path) -> dict[str, npt.NDArray[Any]]:
    """Fields of compressed data, which stores one field of all points after another."""
    size = header.num_points * header.dtype.itemsize
    packed_size, plain_size = struct.unpack("<II", data[:8]) if len(data) >= 8 else (0, -1)
    plain = _unpack_lzf(data[8 : 8 + packed_size], size) if plain_size == size else None
    if plain is None:
        raise InputError(
            f"{path}: is cut or damaged: its compressed data does not hold the {header.num_points} points that its"
            f" header gives; {_REMEDY}"
        )
    columns, first = {}, 0
    for field in header.fields:
        block = np.frombuffer(plain, field.number_format, header.num_points * field.count, first)
        first += block.nbytes
        if field.count == 1:
            columns[field.name] = block
    return columns


def _unpack_lzf(packed: bytes, size: int) -> bytearray | None:
    """Unpack LZF data (Marc Lehmann's liblzf) to ``size`` bytes; None where it is damaged.

    A control byte c below 32 precedes c + 1 literal bytes. Any other precedes a copy of unpacked bytes: three bits of
    length (7: another length byte follows) and 13 bits of distance.
    """
    plain, at = bytearray(), 0
    try:
        while at < len(packed) and len(plain) <= size:
            control = packed[at]
            at += 1
            if control < 32:
                plain += packed[at : at + control + 1]
                at += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += packed[at]
                at += 1
            distance = ((control & 31) << 8) + packed[at] + 1
            at += 1
            start = len(plain) - distance
            if start < 0:
                return None
            # A copy longer than its distance repeats the bytes at its start.
            repeats = (length + 2 + distance - 1) // distance
            plain += (plain[start : start + length + 2] * repeats)[: length + 2]
    except IndexError:
        return None
    return plain if len(plain) == size and at == len(packed) else None
