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
    arrays are compressed together (gzip, RFC 1952). No array is kept after ``is_full``, which is True once they have
    more than ``most_bytes`` compressed bytes.
    """

    def __init__(self, most_bytes: int | None = None) -> None:
        self._most_bytes = most_bytes
        self._packer = zlib.compressobj(6, zlib.DEFLATED, 16 + zlib.MAX_WBITS)
        self._packed: list[bytes] = []
        self._num_packed = 0
        self._size = 0

    @property
    def is_full(self) -> bool:
        """True where the arrays have too many bytes."""
        return self._most_bytes is not None and self._num_packed > self._most_bytes

    def add(self, values: npt.NDArray[Any]) -> dict[str, Any]:
        """Add an array (n,) or (n, k) of one of the types uint8, 16, 32, int16, 32, float32, 64; return its place."""
        array = np.ascontiguousarray(values).astype(values.dtype.newbyteorder("<"), copy=False)
        raw: UInt8Array = array.reshape(-1).view(np.uint8).reshape(-1, array.itemsize)
        place = {"type": _TYPES[array.dtype.str[1:]], "offset": self._size, "count": array.size}
        self._size += array.nbytes
        if not self.is_full:
            self._keep(self._packer.compress(raw.T.tobytes()))
        return place

    def add_all(self, columns: Mapping[str, npt.NDArray[Any]]) -> dict[str, dict[str, Any]]:
        """Add arrays by name; return their places by name."""
        return {name: self.add(values) for name, values in columns.items()}

    def compressed(self) -> bytes:
        """Return all arrays as one gzip member, once all are added; equal arrays give equal bytes."""
        self._keep(self._packer.flush())
        return b"".join(self._packed)

    def _keep(self, packed: bytes) -> None:
        """Keep compressed bytes."""
        self._packed.append(packed)
        self._num_packed += len(packed)
