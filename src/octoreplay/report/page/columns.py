"""Binary container of the page's arrays: one compressed block, and a directory of named columns in it."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from octoreplay.records import UInt8Array

_TYPES = {"u1": "Uint8Array", "u2": "Uint16Array", "u4": "Uint32Array", "i2": "Int16Array", "i4": "Int32Array",
          "f4": "Float32Array", "f8": "Float64Array"}  # fmt: skip
"""Types of the browser's arrays, by NumPy's."""


class Columns:
    """Named arrays for the page.

    The bytes of every array are grouped by their place in a number, lowest first, which compresses better, and all
    arrays are compressed together (gzip, RFC 1952).
    """

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._size = 0

    def add(self, values: npt.NDArray[Any]) -> dict[str, Any]:
        """Add an array (n,) or (n, k) of one of the types uint8, 16, 32, int16, 32, float32, 64; return its place."""
        array = np.ascontiguousarray(values).astype(values.dtype.newbyteorder("<"), copy=False)
        raw: UInt8Array = array.reshape(-1).view(np.uint8).reshape(-1, array.itemsize)
        place = {"type": _TYPES[array.dtype.str[1:]], "offset": self._size, "count": array.size}
        part = raw.T.tobytes()
        self._parts.append(part)
        self._size += len(part)
        return place

    def add_all(self, columns: Mapping[str, npt.NDArray[Any]]) -> dict[str, dict[str, Any]]:
        """Add arrays by name; return their places by name."""
        return {name: self.add(values) for name, values in columns.items()}

    def compressed(self) -> bytes:
        """Return all arrays as one gzip member; equal arrays give equal bytes."""
        packer = zlib.compressobj(6, zlib.DEFLATED, 16 + zlib.MAX_WBITS)
        return b"".join([*map(packer.compress, self._parts), packer.flush()])
