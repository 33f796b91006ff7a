"""Work files of the tiles of a run: what each tick of a tile measured, and its maps where they are stored.

They belong to one run on one machine or one shared file system, and are removed when its result is complete.
"""

from __future__ import annotations

import contextlib
import io
import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from pickle import UnpicklingError
from typing import NamedTuple, Self

import zstandard

from octoreplay.errors import InputError
from octoreplay.io.output_file import writing
from octoreplay.records import RobotPose
from octoreplay.replay.checkpoint import pickled, unpickled
from octoreplay.replay.network.graph import CommunicationGraph
from octoreplay.replay.tick_counts import TickCounts
from octoreplay.run_metrics import LinkMetrics

_LENGTH = struct.Struct("<I")
_MAP = struct.Struct("<IBBHI")
"""Tick, whether it is evidence, whether it is new, and the lengths of name and packet."""


class StoredMap(NamedTuple):
    """Change of one map in one tile since it was stored before.

    - ``number``: the tick.
    - ``is_evidence``: True for evidence s_i, False for a map h_i - h_0.
    - ``name``: robot_id, or 'central'.
    - ``is_new``: True where the map begins anew: the robot restarted, or the map was not stored before.
    - ``delta``: delta packet.
    """

    number: int
    is_evidence: bool
    name: str
    is_new: bool
    delta: bytes


@dataclass(frozen=True, eq=False)
class TileTick:
    """One tick of one tile."""

    number: int
    stamp_ns: int
    settling: bool
    graph: CommunicationGraph
    poses: tuple[RobotPose, ...]
    counts: TickCounts


class WorkFile:
    """Work file, written after the first ``length`` bytes; a context manager. Methods raise OutputError."""

    def __init__(self, path: Path, length: int) -> None:
        self._path = path
        self._graph: CommunicationGraph | None = None
        with writing(path):
            self._file = path.open("r+b" if length else "wb")
            self._file.truncate(length)
            self._file.seek(length)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        with contextlib.suppress(OSError):
            self._file.close()

    def write_tick(self, tick: TileTick) -> None:
        """Write one tick; without its graph where that is the one before."""
        content = {item.name: getattr(tick, item.name) for item in fields(TileTick)}
        content["graph"] = None if tick.graph is self._graph else tick.graph
        # Tuples take a fraction of the time of objects.
        content["counts"] = replace(tick.counts, links=())
        content["links"] = [tuple(vars(link).values()) for link in tick.counts.links]
        self._graph = tick.graph
        data = zstandard.compress(pickled(content), 1)
        with writing(self._path):
            self._file.write(_LENGTH.pack(len(data)) + data)

    def write_map(self, stored: StoredMap) -> None:
        """Write the change of one map."""
        name = stored.name.encode()
        head = _MAP.pack(stored.number, stored.is_evidence, stored.is_new, len(name), len(stored.delta))
        with writing(self._path):
            self._file.write(head + name + stored.delta)

    def flush(self) -> int:
        """Flush to disk what was written; return the length of the file [byte]."""
        with writing(self._path):
            self._file.flush()
            os.fsync(self._file.fileno())
            return self._file.tell()


def read_maps(path: Path, name: str) -> Iterator[StoredMap]:
    """Yield the changes of one map and of its robot's evidence. Raises InputError for a file that cannot be read."""
    wanted = name.encode()
    with _reading(path), path.open("rb") as file:
        while head := file.read(_MAP.size):
            number, is_evidence, is_new, name_length, length = _MAP.unpack(head)
            if file.read(name_length) != wanted:
                file.seek(length, io.SEEK_CUR)
                continue
            delta = file.read(length)
            if len(delta) != length:
                raise struct.error("it is cut")
            yield StoredMap(number, bool(is_evidence), name, bool(is_new), delta)


def read_ticks(path: Path) -> Iterator[TileTick]:
    """Yield the ticks of a tile. Raises InputError for a file that cannot be read."""
    graph = None
    with _reading(path), path.open("rb") as file:
        while head := file.read(_LENGTH.size):
            (length,) = _LENGTH.unpack(head)
            data = file.read(length)
            if len(data) != length:
                raise struct.error("it is cut")
            content = unpickled(zstandard.decompress(data))
            graph = content["graph"] = content["graph"] or graph
            links = tuple(LinkMetrics(*values) for values in content.pop("links"))
            content["counts"] = replace(content["counts"], links=links)
            yield TileTick(**content)


@contextlib.contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Turn errors of a work file into InputError."""
    try:
        yield
    except (OSError, struct.error, zstandard.ZstdError, UnpicklingError, TypeError, KeyError) as error:
        raise InputError(f"{path}: cannot be read: {error}; run with --restart to start from the beginning") from error
