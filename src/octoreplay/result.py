"""Python API of a stored result: any robot's map at any stored tick as arrays, and queries at points and in boxes.

::

    with open_result(Path("result.mcap")) as result:
        stored = result.map("husky_1")                       # the last map; at_ns=... or tick=... for an earlier one
        leaves = stored.leaves()                             # centres, sizes, log-odds
        answer = stored.query(np.array([[1.0, 2.0, 0.5]]))   # labels and probabilities
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self
from weakref import WeakSet

from octoreplay.config.rules import Exchanged
from octoreplay.config.run import RunConfig
from octoreplay.data_table import Table
from octoreplay.errors import ConfigError, InputError, PacketError
from octoreplay.io.results.result_reader import ResultReader
from octoreplay.io.results.tile_files import TileFile
from octoreplay.mapping.codec import apply_delta, decode_packet, max_memory
from octoreplay.mapping.key_box import KeyBox
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.metric_tables import METRIC_TABLES, POSES, metrics_table, pose_table
from octoreplay.records import (
    CENTRAL,
    TEAM,
    ClassTable,
    FilePath,
    Float64Array,
    MapState,
    public_names,
)
from octoreplay.result_tiles import ResultTiles, boxes_of
from octoreplay.run_metrics import FramePlace, RunSummary, TickMetrics
from octoreplay.stored_map import StoredMap, joined_map, key_box

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_log = logging.getLogger(__name__)


class Result:
    """Stored result, opened by ``open_result``; a context manager.

    ``tiles`` are the files that hold the maps of a result in tiles; None where the file itself does.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._reader = ResultReader(path)
        tiles = self._reader.tiles
        self.tiles: ResultTiles[Result] | None = None
        if tiles is not None:
            last = None if self.is_complete else self._reader.last_tick()
            self.tiles = ResultTiles(path, tiles, Result, None if last is None else last[1])
        self._most_bytes = max_memory(path.stat().st_size if self.tiles is None else self.tiles.num_bytes)
        self._octrees: WeakSet[SemanticOctree] = WeakSet()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __dir__(self) -> list[str]:
        return public_names(self)

    def close(self) -> None:
        """Close the file, and those of its tiles."""
        self._reader.close()
        if self.tiles is not None:
            self.tiles.close()

    def plot(
        self, what: str, *, label: str | None = None, beside: Mapping[str, Result] | None = None, style: str = "screen",
        robot: str | None = None, at: float | None = None, color: str | None = None,
        max_depth: int | None = None,
    ) -> Figure:  # fmt: skip
        """Return a matplotlib figure of the run, as ``octoreplay plot`` draws it.

        ``what`` is 'phi', 'packets', 'agreement', 'coverage', 'links', 'contradiction' or 'map'. ``label`` is the name
        of this result in the figure, by default that of its file; ``beside`` are further results by label. ``style`` is
        'screen', 'one-column', 'two-column' or 'talk'. Of a map, ``robot`` is its robot (default: the first one),
        ``at`` its time since the run's start in seconds (default: the end), and ``color`` and ``max_depth`` are as in
        ``export_map``.

        Raises ConfigError for an unknown name, and InputError for a result without what the figure shows.
        """
        # Figures are made in a room above this one, which only those who draw need.
        from octoreplay.report.result_figures import result_figure

        results = {label or self.path.stem: self, **(beside or {})}
        return result_figure(what, results, style, robot=robot, at=at, color=color, max_depth=max_depth)

    @property
    def robots(self) -> tuple[str, ...]:
        """Robots of the team in their order."""
        return self._reader.robots

    @property
    def class_table(self) -> ClassTable:
        """Occupied classes with their names and colours."""
        return self._reader.class_table

    @property
    def config(self) -> RunConfig:
        """Configuration of the run."""
        return self._reader.config

    @property
    def topics(self) -> dict[str, str]:
        """Message type of each topic of the file, by topic."""
        return self._reader.topics

    @property
    def is_complete(self) -> bool:
        """False for the result of an interrupted run."""
        return self._reader.is_complete

    @property
    def extent(self) -> str:
        """Clause on the last tick of an incomplete result and its log time."""
        return self._reader.extent

    @property
    def inputs(self) -> dict[str, tuple[int, str, str]]:
        """Size in bytes, fingerprint method and fingerprint of every input file by path, in the order of the robots."""
        return self._reader.inputs

    @cached_property
    def metrics(self) -> list[TickMetrics]:
        """Metrics of all ticks, in order."""
        return self._reader.metrics()

    @cached_property
    def summary(self) -> RunSummary:
        """Summary of the run; the wall time is not stored and is NaN."""
        return self._reader.summary(self.metrics)

    def as_table(self, kind: str = "ticks") -> Table:
        """Return numbers of the run as a table.

        Parameters
        ----------
        kind : str
            - 'ticks': metrics of the team, one row per tick
            - 'robots', 'links', 'pairs': metrics of each robot, directed link and pair of robots, one row per tick and
              robot, link or pair
            - 'poses': pose of each robot's sensor in the frame ``frame_id``: x, y, z [m], qx, qy, qz, qw, one row per
              tick and robot

            All have the columns ``tick``, ``stamp_ns`` and ``seconds`` since the run's start.

        Raises
        ------
        ConfigError
            ``kind`` is unknown.
        InputError
            The result holds no tick.
        """
        if kind == POSES:
            poses = {robot_id: self._reader.poses(robot_id) for robot_id in self.robots}
            return pose_table(poses, self.metrics, self.start_ns)
        if kind not in METRIC_TABLES:
            raise ConfigError(f"table: '{kind}' is not one of {', '.join((*METRIC_TABLES, POSES))}")
        return metrics_table(self.metrics, kind, self.start_ns)

    @cached_property
    def start_ns(self) -> int:
        """Time t_0 of tick 0. Raises InputError for a result without a tick."""
        if not self.metrics:
            raise InputError(f"{self.path}: holds no tick; the run was interrupted before its first one")
        first = self.metrics[0]
        return first.stamp_ns - first.tick * round(self.config.network.publish_period * 1e9)

    def seconds(self, stamp_ns: int) -> float:
        """Return the time of a stamp since the run's start in seconds."""
        return (stamp_ns - self.start_ns) / 1e9

    def time_ns(self, seconds: float) -> int:
        """Return the stamp at a time since the run's start in seconds. Raises ConfigError for NaN and infinity."""
        if not math.isfinite(seconds):
            raise ConfigError(f"at: {seconds} is no time; give the seconds since the run's start")
        return self.start_ns + round(seconds * 1e9)

    def stored_ticks(self, robot_id: str) -> list[int]:
        """Return the ticks at which a robot's map is stored. Raises InputError for an unknown robot."""
        return [tick for tick, _ in self._state_times(robot_id)]

    def evidence_ticks(self, robot_id: str) -> list[int]:
        """Return the ticks at which a robot's evidence is stored. Raises InputError for an unknown robot."""
        return [tick for tick, _ in self._state_times(robot_id, evidence=True)]

    def poses(self, robot_id: str) -> tuple[list[int], Float64Array]:
        """Return the poses of a robot's sensor at the ticks: stamps [ns], and (P, 7) x, y, z [m], qx, qy, qz, qw.

        They are in the team's frame, or in the robot's present frame where robots find their frames during the run.
        Raises InputError for an unknown robot.
        """
        return self._reader.poses(robot_id)

    def map(
        self, robot_id: str, *, at_ns: int | None = None, tick: int | None = None, bounds: Sequence[float] = (),
    ) -> StoredMap:  # fmt: skip
        """Return a robot's last map stored at or before ``at_ns``, or exactly at ``tick``; with neither, its last map.

        ``robot_id`` 'central' is the centralised map, the sum of all robots' evidence up to then. ``bounds`` are those
        of a run, (zmin, zmax) or (xmin, ymin, zmin, xmax, ymax, zmax) in the map's frame [m]: the map has the cells
        with centres in this box only, bit for bit as in the whole map. Its packets are decompressed as a whole, and
        only the bricks near the box are made. Of a result in tiles only the files of tiles in the box are read.

        Raises InputError for an unknown robot, a tick without a stored map, or a time before the first stored map.
        Raises PacketError where a stored map is damaged or has another format version.
        Raises ConfigError for other bounds, as ``StoredMap.cut``.
        Raises ValueError for both ``at_ns`` and ``tick``.
        """
        return self._last_state(robot_id, at_ns, tick, bounds, evidence=False)

    def evidence(
        self, robot_id: str, *, at_ns: int | None = None, tick: int | None = None, bounds: Sequence[float] = (),
    ) -> StoredMap:  # fmt: skip
        """Return a robot's evidence s_i: the sum of its own scans' log-odds, without anything that others sent.

        ``at_ns``, ``tick`` and ``bounds`` are as in ``map``. The evidence at the end of a run is always stored, earlier
        one every ``evidence_every`` seconds. It is that of the robot's current restart epoch, clamped to ``clamp_min``
        and ``clamp_max`` with ``evidence: sum``, else unclamped.

        The octree of the returned map (``octree``) has the values s_i [log-odds], (C,) in each cell, in the team's
        frame; ``leaves`` and ``query`` return h_0 + s_i, the posterior of the robot's own scans.
        ``config.robots[i].T_team_map`` is the robot's map frame in the team's frame, as the run used it.

        Raises InputError as ``map`` does, and where the result holds no evidence of the robot, which is the case for an
        interrupted run and for results of octoreplay before evidence was stored. Raises PacketError, ConfigError and
        ValueError as ``map`` does.
        """
        return self._last_state(robot_id, at_ns, tick, bounds, evidence=True)

    def _last_state(
        self, robot_id: str, at_ns: int | None, tick: int | None, bounds: Sequence[float], *, evidence: bool
    ) -> StoredMap:
        """Last map or evidence stored at or before ``at_ns``, or exactly at ``tick``, in a box."""
        box = key_box(bounds, self.config.map.resolution) if len(bounds) else None
        if at_ns is not None and tick is not None:
            raise ValueError("give at_ns or tick, not both")
        until_ns = at_ns if tick is None else self._stamp_of(robot_id, tick, evidence=evidence)
        if self.tiles is not None:
            return self._of_tiles(self.tiles, robot_id, until_ns, bounds, box, evidence=evidence)
        states = self._reader.states(robot_id, until_ns, evidence=evidence)
        octree = self._updated(None, states[0], box)
        for state in states[1:]:
            octree = self._updated(octree, state, box)
        stored = self._stored_map(octree, states[-1], is_evidence=evidence)
        return stored.cut(bounds) if len(bounds) else stored

    def _of_tiles(
        self, tiles: ResultTiles[Result], robot_id: str, until_ns: int | None, bounds: Sequence[float],
        box: KeyBox | None, *, evidence: bool,
    ) -> StoredMap:  # fmt: skip
        """Map or evidence in a box from the files of the tiles in it."""
        self._reader.state_topic(robot_id, evidence)
        if until_ns is None or not tiles.has(until_ns):
            until_ns = tiles.end_ns

        def part(file: TileFile) -> StoredMap:
            result, whole = tiles.opened(file), box is None or tiles.is_inside(file, box)
            read = result.evidence if evidence else result.map
            return read(robot_id, at_ns=until_ns, bounds=() if whole else bounds)

        return joined_map(map(part, tiles.touching(box)), self._most_bytes)

    def boxes(
        self, bounds: Sequence[float] = (), *, beside: Sequence[Result] = (), max_depth: int | None = None
    ) -> Iterator[tuple[float, ...]]:
        """Yield boxes for ``bounds`` of ``map``, ``evidence`` and ``history`` that hold each known cell once.

        A result in tiles gives one box for each tile, so that a reader of one box after the other holds the maps of
        one tile. An ordinary result gives the whole, ``bounds``.

        Parameters
        ----------
        bounds : sequence of float
            Box to cut, as in ``map``; empty for the whole map.
        beside : sequence of Result
            Results of the same resolution that are read together with this one: boxes hold whole tiles of all of them.
        max_depth : int, optional
            Depth of the finest cells that the reader makes of each part (``StoredMap.coarsened``); none is cut.
        """
        return boxes_of([result.tiles for result in (self, *beside)], self.config.map.resolution, bounds, max_depth)

    def history(self, *, bounds: Sequence[float] = ()) -> Iterator[dict[str, StoredMap]]:
        """Yield the maps at every stored tick by robot_id, with 'central' if it is stored.

        ``bounds`` are as in ``map``. The next step changes the octrees in place. Raises PacketError and ConfigError as
        ``map`` does.
        """
        box = key_box(bounds, self.config.map.resolution) if len(bounds) else None
        if self.tiles is not None:
            yield from self._history_of_tiles(self.tiles, bounds, box)
            return
        octrees: dict[str, SemanticOctree] = {}
        maps: dict[str, StoredMap] = {}
        tick: int | None = None
        for state in self._reader.all_states():
            if tick is not None and state.tick != tick:
                yield maps if box is None else {name: stored.cut(bounds) for name, stored in maps.items()}
            tick = state.tick
            octrees[state.robot_id] = self._updated(octrees.get(state.robot_id), state, box)
            maps[state.robot_id] = self._stored_map(octrees[state.robot_id], state)
        if maps:
            yield maps if box is None else {name: stored.cut(bounds) for name, stored in maps.items()}

    def _history_of_tiles(
        self, tiles: ResultTiles[Result], bounds: Sequence[float], box: KeyBox | None
    ) -> Iterator[dict[str, StoredMap]]:
        """Maps in a box at every stored tick from the files of the tiles in it."""
        with ExitStack() as stack:
            histories = []
            for file in tiles.touching(box):
                whole = box is None or tiles.is_inside(file, box)
                result = stack.enter_context(tiles.open_new(file))
                histories.append(result.history(bounds=() if whole else bounds))
            for parts in zip(*histories, strict=True):
                if not tiles.has(max(stored.stamp_ns for stored in parts[0].values())):
                    return
                yield {name: joined_map((maps[name] for maps in parts), self._most_bytes) for name in parts[0]}

    def _updated(self, octree: SemanticOctree | None, state: MapState, box: KeyBox | None = None) -> SemanticOctree:
        """Octree, near a box, after a stored state.

        All octrees in use have at most the memory that fits the size of the file.
        """
        room = self._most_bytes - sum(held.memory_bytes for held in self._octrees)
        try:
            if state.is_key_frame:
                octree = decode_packet(state.data, room, box)
                cells = (self.config.map.resolution, self.class_table.num_classes)
                if (octree.resolution, octree.num_classes) != cells:
                    raise PacketError("damaged: the map has another resolution or number of classes than the run")
                self._octrees.add(octree)
            elif octree is None:
                raise PacketError("damaged: the first stored state is a delta")
            else:
                apply_delta(octree, state.data, most_bytes=room, box=box)
        except PacketError as error:
            raise PacketError(f"{self.path}: robot '{state.robot_id}': {error}; replay the logs again") from error
        return octree

    def _stored_map(self, octree: SemanticOctree, state: MapState, *, is_evidence: bool = False) -> StoredMap:
        """Map or evidence after a stored state."""
        num_robots = state.num_robots
        if num_robots is None:
            num_robots = 1 if is_evidence else self._num_averaged(state)
        return StoredMap(
            octree, state.robot_id, state.tick, state.stamp_ns, self._reader.prior, num_robots, state.frame_id,
            self._most_bytes,
        )  # fmt: skip

    def _num_averaged(self, state: MapState) -> int:
        """N of a state in a result without it: the robots in the map's frame, or all with rule 'flood'."""
        consensus = self.config.consensus
        if state.robot_id == CENTRAL or not consensus.map_is_mean:
            return 1
        places = self._places.get(state.tick, ())
        if not places or consensus.traits.exchanges is Exchanged.EVIDENCE:
            return len(self.robots)
        return sum(place.frame_id == state.frame_id for place in places)

    @cached_property
    def places(self) -> dict[str, FramePlace]:
        """Frame of each robot's last map with the place of the robot's own map frame in it, by robot_id."""
        if self._places:
            return {place.robot_id: place for place in self._places[max(self._places)]}
        return {
            robot.robot_id: FramePlace(robot.robot_id, TEAM, robot.T_team_map_or_identity)
            for robot in self.config.robots
        }

    @cached_property
    def _places(self) -> dict[int, tuple[FramePlace, ...]]:
        """Frames of all robots by tick."""
        return self._reader.places()

    def _state_times(self, robot_id: str, *, evidence: bool = False) -> list[tuple[int, int]]:
        """Tick and stamp of each stored map or evidence of a robot."""
        times = self._states_reader(robot_id, evidence=evidence).state_times(robot_id, evidence=evidence)
        return [(tick, stamp_ns) for tick, stamp_ns in times if self.tiles is None or self.tiles.has(stamp_ns)]

    def _states_reader(self, robot_id: str, *, evidence: bool = False) -> ResultReader:
        """Reader of a file with stored states of a robot; all tiles store them at the same ticks."""
        self._reader.state_topic(robot_id, evidence)
        return self._reader if self.tiles is None else self.tiles.reader

    def _stamp_of(self, robot_id: str, tick: int, *, evidence: bool) -> int:
        """Stamp of a robot's map or evidence stored at a tick."""
        stamp_ns = self._states_reader(robot_id, evidence=evidence).state_stamp(robot_id, tick, evidence=evidence)
        if stamp_ns is None or not (self.tiles is None or self.tiles.has(stamp_ns)):
            ticks = self.evidence_ticks(robot_id) if evidence else self.stored_ticks(robot_id)
            near = sorted(sorted(ticks, key=lambda stored: abs(stored - tick))[:6])
            raise InputError(
                f"{self.path}: no {'evidence' if evidence else 'map'} of robot '{robot_id}' is stored at tick {tick};"
                f" stored nearby: {', '.join(map(str, near)) or 'none'}"
            )
        return stamp_ns


def open_result(path: FilePath) -> Result:
    """Open a result file; a warning says where an incomplete one ends.

    Raises InputError for a file that is missing, damaged or not an octoreplay result.
    """
    result = Result(Path(path))
    if not result.is_complete:
        _log.warning("warning: %s: incomplete: the run did not finish, and its result %s", path, result.extent)
    return result
