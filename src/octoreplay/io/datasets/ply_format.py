"""Reader of the PLY file format: text, and binary of both byte orders.

Format: Greg Turk, "The PLY Polygon File Format", 1994.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
_BYTE_ORDERS = {b"ascii": "", b"binary_little_endian": "<", b"binary_big_endian": ">"}
_MAX_HEADER_BYTES = 1 << 20


class PlyError(ValueError):
    """Bytes that are no whole PLY file; the message is a clause."""


class _Property(NamedTuple):
    """Property of an element: a number, or with ``length`` a list; both are types of numpy."""

    name: str
    type: str
    length: str | None


class _Element(NamedTuple):
    """Rows of one kind, such as 'vertex'."""

    name: str
    num_rows: int
    properties: tuple[_Property, ...]

    @property
    def has_lists(self) -> bool:
        """True where a property is a list."""
        return any(prop.length is not None for prop in self.properties)

    def dtype(self, order: str, lengths: Sequence[int] = ()) -> np.dtype[Any]:
        """Type of a row in a byte order; each list has the next of ``lengths``, after its own length."""
        rest, fields = list(lengths), []
        for name, kind, length in self.properties:
            if length is not None:
                fields += [(f"{name} length", order + length), (name, order + kind, (rest.pop(0),))]
            else:
                fields.append((name, order + kind))
        return np.dtype(fields)


def read_elements(data: bytes) -> dict[str, npt.NDArray[Any]]:
    """Return the elements of a PLY file: rows (n,) as structured arrays in the machine's byte order.

    A list is a field of shape (n, length) where all rows have the same length, else an object field of arrays. Raises
    PlyError where the file is cut, longer than its header says, or otherwise damaged. The memory is bounded by the
    length of the file.
    """
    order, elements, start = _read_header(data)
    if order:
        found, end = _read_binary(memoryview(data), start, order, elements)
        rest = data[end:].strip()
    else:
        lines = [line for line in data[start:].splitlines() if line.strip()]
        found, num_used = _read_text(lines, elements)
        rest = b"".join(lines[num_used:])
    if rest:
        raise PlyError("it is longer than its header says")
    return found


def _read_header(data: bytes) -> tuple[str, list[_Element], int]:
    """Byte order (empty: text), elements, and the place where the header ends."""
    file = io.BytesIO(data[:_MAX_HEADER_BYTES].replace(b"\r\n", b" \n").replace(b"\r", b"\n"))
    if file.readline().strip() != b"ply":
        raise PlyError("it does not begin with 'ply'")
    order: str | None = None
    elements: list[_Element] = []
    while line := file.readline():
        words = line.split()
        if words[:1] == [b"end_header"] and line.endswith(b"\n"):
            if order is None:
                raise PlyError("its header has no format")
            return order, elements, file.tell()
        if words[:1] == [b"format"]:
            if words[1:] != [*words[1:2], b"1.0"] or words[1] not in _BYTE_ORDERS:
                raise PlyError("its format is unknown")
            order = _BYTE_ORDERS[words[1]]
        elif words[:1] == [b"element"]:
            elements.append(_element(words))
            if len({element.name for element in elements}) < len(elements):
                raise PlyError(f"its header has two elements '{elements[-1].name}'")
        elif words[:1] == [b"property"] and elements:
            prop = _property(words)
            if prop.name in {other.name for other in elements[-1].properties}:
                raise PlyError(f"its header has two properties '{prop.name}'")
            elements[-1] = elements[-1]._replace(properties=(*elements[-1].properties, prop))
        elif words and words[0] not in (b"comment", b"obj_info"):
            raise PlyError(f"its header has an unknown line '{_text(line.strip()[:40])}'")
    raise PlyError("its header has no end")


def _element(words: Sequence[bytes]) -> _Element:
    """The element that a line of the header begins."""
    if len(words) != 3 or not words[2].isdigit() or len(words[2]) > 18:
        raise PlyError("its header has an element without a name or a number of rows")
    return _Element(_text(words[1]), int(words[2]), ())


def _property(words: Sequence[bytes]) -> _Property:
    """The property that a line of the header describes."""
    is_list = words[1:2] == [b"list"]
    types = [_TYPES.get(_text(word)) for word in words[2 if is_list else 1 : -1]]
    kind, length = types[-1] if types else None, types[0] if is_list and types else None
    if len(types) != 1 + is_list or kind is None or (is_list and (length is None or length[0] == "f")):
        raise PlyError("its header has a property of an unknown type")
    return _Property(_text(words[-1]), kind, length)


def _text(word: bytes) -> str:
    """Text of a word; bytes that are no ASCII are replaced."""
    return word.decode("ascii", "replace")


# --- binary ----------------------------------------------------------------------------------------------------------


def _read_binary(
    data: memoryview, place: int, order: str, elements: Sequence[_Element]
) -> tuple[dict[str, npt.NDArray[Any]], int]:
    """The elements from a place on, and the place after them."""
    found = {}
    for element in elements:
        rows = _equal_rows(data, place, order, element)
        if rows is not None:
            place += rows.nbytes
            names = [prop.name for prop in element.properties]
            found[element.name] = rows[names].astype(rows[names].dtype.newbyteorder("="), copy=True)
        else:
            found[element.name], place = _different_rows(data, place, order, element)
    return found, place


def _equal_rows(data: memoryview, place: int, order: str, element: _Element) -> npt.NDArray[Any] | None:
    """Rows with lists of the lengths of the first row; None where other rows have other lengths."""
    lengths, first = [], place
    for prop in element.properties if element.num_rows else ():
        if prop.length is not None:
            lengths.append(_length(data, first, order, prop))
            first += np.dtype(prop.length).itemsize + lengths[-1] * np.dtype(prop.type).itemsize
        else:
            first += np.dtype(prop.type).itemsize
    if not element.num_rows:
        lengths = [0] * len(element.properties)
    dtype = element.dtype(order, lengths)
    if not element.properties and element.num_rows:
        raise PlyError(f"its element '{element.name}' has rows but no properties")
    if element.num_rows * dtype.itemsize > len(data) - place:
        if element.has_lists and element.num_rows <= len(data) - place:
            return None
        raise PlyError(f"its element '{element.name}' is cut")
    rows = np.frombuffer(data, dtype, element.num_rows, place)
    lists = [prop.name for prop in element.properties if prop.length is not None]
    is_equal = all((rows[f"{name} length"] == n).all() for name, n in zip(lists, lengths, strict=False))
    return rows if is_equal else None


def _different_rows(data: memoryview, place: int, order: str, element: _Element) -> tuple[npt.NDArray[Any], int]:
    """Rows whose lists have different lengths, and the place after them."""
    rows = np.empty(element.num_rows, [(p.name, p.type if p.length is None else "O") for p in element.properties])
    for index in range(element.num_rows):
        for prop in element.properties:
            count = 1
            if prop.length is not None:
                count = _length(data, place, order, prop)
                place += np.dtype(prop.length).itemsize
            dtype = np.dtype(order + prop.type)
            if count * dtype.itemsize > len(data) - place:
                raise PlyError(f"its element '{element.name}' is cut")
            values = np.frombuffer(data, dtype, count, place)
            rows[prop.name][index] = values[0] if prop.length is None else values
            place += values.nbytes
    return rows, place


def _length(data: memoryview, place: int, order: str, prop: _Property) -> int:
    """Length of the list at a place."""
    dtype = np.dtype(order + str(prop.length))
    if dtype.itemsize > len(data) - place:
        raise PlyError(f"its list '{prop.name}' is cut")
    length = int(np.frombuffer(data, dtype, 1, place)[0])
    if not 0 <= length <= len(data) - place:
        raise PlyError(f"its list '{prop.name}' has {length} numbers")
    return length


# --- text ------------------------------------------------------------------------------------------------------------


def _read_text(lines: Sequence[bytes], elements: Sequence[_Element]) -> tuple[dict[str, npt.NDArray[Any]], int]:
    """The elements of lines that are not blank, one row each, and the number of lines."""
    found, num_used = {}, 0
    for element in elements:
        rows = lines[num_used : num_used + element.num_rows]
        num_used += len(rows)
        if len(rows) < element.num_rows:
            raise PlyError(f"its element '{element.name}' is cut")
        read = _read_lists if element.has_lists else _read_table
        try:
            # Numbers may be too large for their type.
            with np.errstate(over="ignore", invalid="ignore"):
                found[element.name] = read(rows, element)
        except (ValueError, OverflowError) as error:
            if isinstance(error, PlyError):
                raise
            raise PlyError(f"its element '{element.name}' has a row that does not fit its properties") from error
    return found, num_used


def _read_table(rows: Sequence[bytes], element: _Element) -> npt.NDArray[Any]:
    """Rows of numbers."""
    dtype = element.dtype("=")
    if not rows:
        return np.empty(0, dtype)
    return np.loadtxt([_text(row) for row in rows], dtype, comments=None, ndmin=1)


def _read_lists(rows: Sequence[bytes], element: _Element) -> npt.NDArray[Any]:
    """Rows with lists."""
    table = np.empty(len(rows), [(p.name, p.type if p.length is None else "O") for p in element.properties])
    for index, row in enumerate(rows):
        words = row.split()
        for prop in element.properties:
            count = 1
            if prop.length is not None:
                count = int(words.pop(0)) if words else -1
            if not 0 <= count <= len(words):
                raise PlyError(f"its element '{element.name}' has a row that is too short")
            number = float if prop.type[0] == "f" else int
            values = np.array([number(word) for word in words[:count]], prop.type)
            table[prop.name][index] = values[0] if prop.length is None else values
            del words[:count]
        if words:
            raise PlyError(f"its element '{element.name}' has a row that is too long")
    return table
