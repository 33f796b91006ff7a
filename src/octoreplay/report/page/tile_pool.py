"""Contents of tiles, each stored once, in a temporary file."""

from __future__ import annotations

import contextlib
import hashlib
import os
import tempfile
from collections.abc import Mapping, Sequence
from itertools import accumulate
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from octoreplay.io.output_file import writing
from octoreplay.records import UInt32Array

STARTS = "starts"
"""Column with the first row of each contents, and the end of the last one."""


class TilePool:
    """Contents of tiles, each stored once, in a temporary file; a context manager.

    ``fields`` are the names and types of the columns. Threads may call ``column`` at the same time, but not while
    contents are added. Methods raise OutputError where the file cannot be written.
    """

    def __init__(self, fields: Mapping[str, str]) -> None:
        self._fields = {name: np.dtype(kind) for name, kind in fields.items()}
        sizes = accumulate((kind.itemsize for kind in self._fields.values()), initial=0)
        self._before = dict(zip(self._fields, sizes, strict=False))
        self._known: dict[bytes, int] = {}
        self._counts: list[int] = []
        self._offsets = [0]
        self._tables: dict[str, npt.NDArray[Any]] = {}
        with writing(Path(tempfile.gettempdir())):
            self._file = tempfile.TemporaryFile()  # noqa: SIM115 - __exit__ closes it.

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        # After a failed write the rest of the data cannot be written either.
        with contextlib.suppress(OSError):
            self._file.close()

    def __len__(self) -> int:
        return len(self._counts)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all columns."""
        return (STARTS, *self._fields)

    def add(self, columns: Mapping[str, npt.NDArray[Any]]) -> int:
        """Add a tile's columns, (n,) each, and return the index of its contents."""
        data = b"".join([columns[name].astype(kind).tobytes() for name, kind in self._fields.items()])
        digest = hashlib.blake2b(data, digest_size=16).digest()
        found = self._known.setdefault(digest, len(self._counts))
        if found == len(self._counts):
            self._counts.append(len(columns[next(iter(self._fields))]))
            with writing(Path(tempfile.gettempdir())):
                self._file.write(data)
            self._offsets.append(self._offsets[-1] + len(data))
        return found

    def column(self, name: str, wanted: Sequence[int] | UInt32Array) -> npt.NDArray[Any]:
        """Return a column of some contents, one after the other, or their ``STARTS``."""
        indices = [int(index) for index in wanted]
        counts = [self._counts[index] for index in indices]
        if name == STARTS:
            return np.concatenate([[0], np.cumsum(counts)]).astype(np.uint32)
        kind, before = self._fields[name], self._before[name]
        with writing(Path(tempfile.gettempdir())):
            self._file.flush()
            parts = [
                os.pread(self._file.fileno(), count * kind.itemsize, self._offsets[index] + count * before)
                for index, count in zip(indices, counts, strict=True)
            ]
        values: npt.NDArray[Any] = np.frombuffer(b"".join(parts), kind)
        return self._tables[name][values] if name in self._tables else values

    def columns(self, wanted: Sequence[int] | UInt32Array) -> dict[str, npt.NDArray[Any]]:
        """Return all columns of some contents by name."""
        return {name: self.column(name, wanted) for name in self.names}

    def replace(self, name: str, table: npt.NDArray[Any]) -> None:
        """Replace each value v of a column by ``table[v]``, of the column's type; once all contents are added."""
        self._tables[name] = table.astype(self._fields[name])
