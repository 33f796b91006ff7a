"""Work files of the tiles of a run: what each tick of a tile measured, and its maps where they are stored.

They belong to one run on one machine or one shared file system, and are removed when its result is complete.
"""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from pickle import UnpicklingError

import zstandard

from octoreplay.errors import InputError
from octoreplay.io.output_file import writing
from octoreplay.records import RobotPose
from octoreplay.replay.checkpoint import pickled, unpickled
from octoreplay.replay.network.graph import CommunicationGraph
from octoreplay.replay.tick_counts import TickCounts

_LENGTH = struct.Struct("<I")


StoredMaps = dict[str, tuple[bool, bytes]]
"""Changes of maps in one tile since they were stored before, by robot_id, 'central' for the centralised map.

Each is a delta packet, and True where the map begins anew: the robot restarted, or the map was not stored before.
"""


@dataclass(frozen=True, eq=False)
class TileTick:
    """One tick of one tile. ``maps`` and ``evidence`` are None where they are not stored."""

    number: int
    stamp_ns: int
    settling: bool
    graph: CommunicationGraph
    poses: tuple[RobotPose, ...]
    counts: TickCounts
    maps: StoredMaps | None
    evidence: StoredMaps | None


class TickFile:
    """File of the ticks of a tile, written after the first ``length`` bytes; a context manager."""

    def __init__(self, path: Path, length: int) -> None:
        self._path = path
        with writing(path):
            self._file = path.open("r+b" if length else "wb")
            self._file.truncate(length)
            self._file.seek(length)

    def __enter__(self) -> TickFile:
        return self

    def __exit__(self, *error: object) -> None:
        with contextlib.suppress(OSError):
            self._file.close()

    def write(self, tick: TileTick) -> None:
        """Write one tick. Raises OutputError."""
        data = zstandard.compress(pickled({item.name: getattr(tick, item.name) for item in fields(TileTick)}), 1)
        with writing(self._path):
            self._file.write(_LENGTH.pack(len(data)) + data)

    def flush(self) -> int:
        """Hand what was written to the operating system; return the length of the file [byte]. Raises OutputError."""
        with writing(self._path):
            self._file.flush()
            return self._file.tell()


def read_ticks(path: Path) -> Iterator[TileTick]:
    """Yield the ticks of a tile. Raises InputError for a file that is cut or cannot be read."""
    try:
        with path.open("rb") as file:
            while head := file.read(_LENGTH.size):
                (length,) = _LENGTH.unpack(head)
                data = file.read(length)
                if len(data) != length:
                    raise InputError(f"{path}: is cut; run with --restart to start from the beginning")
                yield TileTick(**unpickled(zstandard.decompress(data)))
    except (OSError, struct.error, zstandard.ZstdError, UnpicklingError, TypeError) as error:
        raise InputError(f"{path}: cannot be read: {error}; run with --restart to start from the beginning") from error
