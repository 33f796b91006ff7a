"""Maps of a whole run from those of its tiles, each robot's map by itself."""

from __future__ import annotations

import heapq
import itertools
import logging
import pickle
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from operator import attrgetter
from pathlib import Path
from typing import IO, Any, NamedTuple

from octoreplay.config.resolved import ResolvedRun
from octoreplay.io.output_file import writing
from octoreplay.mapping import codec
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.records import CENTRAL, TEAM
from octoreplay.replay.map_recorder import MAP_WRITES, MapRecorder, MapSink, MapTick
from octoreplay.replay.num_averaged import NumAveraged
from octoreplay.study.tiles.geometry import Tile
from octoreplay.study.tiles.stage import TileFiles
from octoreplay.study.tiles.work import StoredMap, read_maps, read_ticks
from octoreplay.study.tiles.worker import Request, Setup, Workers

_log = logging.getLogger(__name__)


class TickTime(NamedTuple):
    """One tick: its time, and the number of robots that each map is the mean of."""

    stamp_ns: int
    num_robots: Mapping[str, int]

    def of_map(self, name: str) -> TickTime:
        """Return the tick with the number of one map."""
        return TickTime(self.stamp_ns, {name: self.num_robots[name]})


class JoinedMaps:
    """Stored maps of a run whose tiles are complete. Each map is encoded by itself, with its robot's evidence.

    Attributes
    ----------
    num_evidence_cells : dict
        Known cells of each robot's evidence, by robot_id.
    """

    def __init__(self, config: ResolvedRun, tiles: Sequence[Tile], folder: Path) -> None:
        self.num_evidence_cells: dict[str, int] = {}
        self._config = config
        self._tiles = tuple(tiles)
        self._files = [TileFiles(folder, tile) for tile in tiles]
        self._folder = folder / f"{tiles[0].name}.joined"
        self._robot_ids = [robot.robot_id for robot in config.robots]
        self._names = (*self._robot_ids, CENTRAL)

    def encode(self, num_threads: int) -> None:
        """Encode all maps into work files, from which ``write`` takes them. Raises InputError and OutputError."""
        times = self._times()
        for index in range(len(self._names)):
            self.encode_map(index, times, num_threads, _log.warning)

    def encode_in(self, workers: Workers, memory_bytes: int, show: Callable[[int, int], None]) -> None:
        """Encode all maps as ``encode`` does, each by any of the ``workers``.

        ``memory_bytes`` is the forecast for one of them; ``show`` is called with the numbers of encoded maps and of
        all.
        """
        times = self._times()
        requests = [
            Request(
                f"map of {name}", encode_map, (self._tiles, index, [time.of_map(name) for time in times]), memory_bytes
            )
            for index, name in enumerate(self._names)
        ]
        warnings: dict[int, list[str]] = {}
        for index, num_cells, of_map in workers.answers(requests):
            warnings[index] = of_map
            if index < len(self._robot_ids):
                self.num_evidence_cells[self._names[index]] = num_cells
            show(len(warnings), len(self._names))
        for _, of_map in sorted(warnings.items()):
            for warning in of_map:
                _log.warning(warning)

    def encode_map(self, index: int, times: Sequence[TickTime], num_threads: int, warn: Callable[[str], None]) -> None:
        """Encode the map of one robot, or the centralised map after those of all robots, into work files.

        ``warn`` is called with a sentence for each form of the map that cannot be stored.
        """
        with writing(self._folder):
            self._folder.mkdir(exist_ok=True)
        name = self._names[index]
        with ThreadPoolExecutor(num_threads) as threads, _Spool(self._folder, index) as spool:
            recorder = MapRecorder(self._config, spool, threads, warn)
            for tick in self._map_ticks(name, times):
                spool.number = tick.number
                recorder.record(tick)
                if tick.number == len(times) - 1:
                    recorder.finish(tick)

    def write(self, sink: MapSink) -> Iterator[None]:
        """Give the maps of one tick after the other to a sink, in the order of a whole run."""
        rows = [
            [_Entries(self._folder / _spool_name(index, write)) for index in range(len(self._names))]
            for write in MAP_WRITES
        ]
        with ExitStack() as stack:
            for entries in itertools.chain(*rows):
                stack.enter_context(entries)
            for number in itertools.count():
                for write, of_names in zip(MAP_WRITES, rows, strict=True):
                    for arguments in itertools.chain(*(entries.of_tick(number) for entries in of_names)):
                        sink.add(write, *arguments)
                        sink.start()
                yield

    def _times(self) -> list[TickTime]:
        """All ticks."""
        averaged, times = NumAveraged(self._config), []
        for tick in read_ticks(self._files[0].ticks):
            averaged.update(tick.graph)
            times.append(TickTime(tick.stamp_ns, dict(averaged.by_name)))
        return times

    def _map_ticks(self, name: str, times: Sequence[TickTime]) -> Iterator[MapTick]:
        """One map, and its robot's evidence, in each tick in which tiles stored it, the last one included."""
        octrees = {False: self._octree(), True: self._octree()}
        is_robot = name != CENTRAL
        for number, changes in itertools.groupby(self._changes(name), attrgetter("number")):
            begun: set[bool] = set()
            for stored in changes:
                # All tiles of a map begin anew in the same tick.
                if stored.is_new and stored.is_evidence not in begun:
                    octrees[stored.is_evidence] = self._octree()
                    begun.add(stored.is_evidence)
                codec.apply_delta(octrees[stored.is_evidence], stored.delta, number)
            yield MapTick(
                number, times[number].stamp_ns, times[number].stamp_ns - times[0].stamp_ns, {name: octrees[False]},
                {name: octrees[True]} if is_robot else {}, times[number].num_robots, {name: TEAM},
            )  # fmt: skip
        if is_robot:
            self.num_evidence_cells[name] = octrees[True].num_cells

    def _changes(self, name: str) -> Iterator[StoredMap]:
        """Changes of a map and of its robot's evidence in all tiles, tick by tick."""
        streams = (read_maps(files.maps, name) for files in self._files)
        ends = itertools.chain.from_iterable(read_maps(files.last_maps, name) for files in self._files)
        return itertools.chain(heapq.merge(*streams, key=attrgetter("number")), ends)

    def _octree(self) -> SemanticOctree:
        return SemanticOctree(self._config.map.resolution, self._config.classes.num_classes)


class OtherMaps:
    """Maps of a run that other files hold; ``num_evidence_cells`` are as in ``JoinedMaps``."""

    def __init__(self, num_evidence_cells: Mapping[str, int]) -> None:
        self.num_evidence_cells = num_evidence_cells

    def write(self, _: MapSink) -> Iterator[None]:
        """Give nothing to a sink, tick after tick."""
        yield from itertools.repeat(None)


def _spool_name(index: int, write: str) -> str:
    """Name of the file of one map's calls of a method."""
    return f"{index}.{write}"


class _Spool:
    """Files of the calls that record one map; a context manager. ``number`` is that of the tick."""

    def __init__(self, folder: Path, index: int) -> None:
        self.number = 0
        with ExitStack() as stack:
            with writing(folder):
                self._files = {
                    write: stack.enter_context((folder / _spool_name(index, write)).open("wb")) for write in MAP_WRITES
                }
            self._closing = stack.pop_all()
        self._folder = folder

    def __enter__(self) -> _Spool:
        return self

    def __exit__(self, *error: object) -> None:
        with writing(self._folder):
            self._closing.close()

    def add(self, write: str, *arguments: Any) -> None:
        """Write a call."""
        with writing(self._folder):
            pickle.dump(self.number, self._files[write], protocol=5)
            pickle.dump(arguments, self._files[write], protocol=5)

    def start(self) -> None:
        """Do nothing: calls are written at once."""


class _Entries:
    """Calls in one file of a ``_Spool``; a context manager that removes the file."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __enter__(self) -> None:
        self._file: IO[bytes] = self._path.open("rb")
        self._number = self._next_number()

    def __exit__(self, *error: object) -> None:
        self._file.close()
        with writing(self._path):
            self._path.unlink(missing_ok=True)

    def of_tick(self, number: int) -> Iterator[tuple[Any, ...]]:
        """Arguments of the calls of one tick."""
        while self._number == number:
            arguments: tuple[Any, ...] = pickle.load(self._file)
            yield arguments
            self._number = self._next_number()

    def _next_number(self) -> int | None:
        """Tick of the next call, None at the end; the arguments, which are large, are read when they are written."""
        try:
            number: int = pickle.load(self._file)
        except EOFError:
            return None
        return number


def encode_map(
    setup: Setup, tiles: Sequence[Tile], index: int, times: Sequence[TickTime]
) -> tuple[int, int, list[str]]:
    """Encode one map of a run, as a request to a worker.

    Return the index, the known cells of the robot's evidence (0 for the centralised map), and warnings.
    """
    maps, warnings = JoinedMaps(setup.config, tiles, setup.folder), list[str]()
    maps.encode_map(index, times, setup.num_threads, warnings.append)
    return index, next(iter(maps.num_evidence_cells.values()), 0), warnings
