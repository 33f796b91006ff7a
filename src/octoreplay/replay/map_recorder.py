"""Recording of maps: stored states and evidence every few seconds, and forms for other programs."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from octoreplay.config.output import OutputConfig
from octoreplay.config.resolved import ResolvedRun
from octoreplay.io.results.map_views import view_points
from octoreplay.io.results.occupancy_grid import Grid, grid_of
from octoreplay.io.results.octomap_trees import binary_tree
from octoreplay.mapping import codec
from octoreplay.mapping.consensus import scaled_map
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.records import CENTRAL, LeafTable, MapState
from octoreplay.replay.tick import falls_due

_log = logging.getLogger(__name__)

STATES_PER_KEY_FRAME = 12
"""Number of stored states of a robot from one key frame to the next."""
MAPS_AT_ONCE = 4
"""Number of maps whose stored forms wait for the writer at the same time; those of a large team may exceed its maps."""


def _view(octree: SemanticOctree, _: int, config: ResolvedRun) -> npt.NDArray[Any]:
    """Points of the occupied leaves of a map as the robot holds it."""
    prior = config.map.prior(octree.num_classes)
    return view_points(octree.leaves(prior, occupied_only=True), config.classes)


def _posterior(octree: SemanticOctree, num_robots: int, config: ResolvedRun) -> LeafTable:
    """Leaves of the posterior of the robots that a map is the mean of."""
    shown = octree if num_robots == 1 else scaled_map(octree, float(num_robots))
    return shown.leaves(config.map.prior(octree.num_classes))


def _grid(octree: SemanticOctree, num_robots: int, config: ResolvedRun) -> Grid | None:
    """Occupancy grid of a map, None where nothing lies in its heights."""
    leaves, output = _posterior(octree, num_robots, config), config.output
    low = -math.inf if output.grid_low is None else output.grid_low
    high = math.inf if output.grid_high is None else output.grid_high
    leaves = leaves.taken(leaves.between(low, high))
    return grid_of(leaves, config.map.resolution) if len(leaves) else None


def _octomap(octree: SemanticOctree, num_robots: int, config: ResolvedRun) -> bytes | None:
    """Nodes of the OctoMap tree of a map, None for an empty one."""
    leaves = _posterior(octree, num_robots, config)
    return binary_tree(leaves, config.map.resolution) if len(leaves) else None


class _Form(NamedTuple):
    """Form of the maps for other programs: its period in the configuration, its encoder and its method to write."""

    period: str
    encode: Callable[[SemanticOctree, int, ResolvedRun], Any]
    write: str


_SHOWN: Mapping[str, _Form] = {
    "view": _Form("view_every", _view, "write_view"),
    "cubes": _Form("markers_every", _view, "write_cubes"),
    "occupancy grid": _Form("grid_every", _grid, "write_grid"),
    "OctoMap tree": _Form("octomap_every", _octomap, "write_octomap"),
}
"""Forms of the maps for other programs by name."""


MAP_WRITES = ("write_state", "write_evidence", *dict.fromkeys(form.write for form in _SHOWN.values()))
"""Methods that write maps, in the order in which they are called in a tick."""


def shown_periods(output: OutputConfig) -> dict[str, float]:
    """Return the period [s] of each form of the maps that is stored for other programs."""
    periods = {name: getattr(output, form.period) for name, form in _SHOWN.items()}
    return {name: every for name, every in periods.items() if every is not None}


def map_periods(output: OutputConfig) -> tuple[float, ...]:
    """Return the periods [s] at which maps are stored in any form."""
    return (output.state_every, *shown_periods(output).values())


class MapTick(NamedTuple):
    """Maps after one tick, of all robots or of some.

    - ``number``, ``stamp_ns``: number and time of the tick.
    - ``elapsed_ns``: time since the first tick.
    - ``maps``: octrees h_i - h_0 by name, 'central' for the centralised map; the same names in all ticks.
    - ``evidence``: octrees s_i by robot_id.
    - ``num_robots``: number of robots that each map is the mean of, by name.
    - ``frame_ids``: frame of each map, by name.
    """

    number: int
    stamp_ns: int
    elapsed_ns: int
    maps: Mapping[str, SemanticOctree]
    evidence: Mapping[str, SemanticOctree]
    num_robots: Mapping[str, int]
    frame_ids: Mapping[str, str]


class MapSink(Protocol):
    """Receiver of what is recorded of maps."""

    def add(self, write: str, *arguments: Any) -> None:
        """Take a call of a method of ``ResultWriter`` whose arguments do not change any more."""

    def start(self) -> None:
        """Begin to write what was added; waits for what was added before the last call."""


class _StateSeries:
    """Stored states of some octrees over time: key frames, and deltas with the bricks that changed between them."""

    def __init__(self, threads: Executor) -> None:
        self.last_tick = -1
        self._threads = threads
        self._num_stored = 0
        self._octrees: dict[str, SemanticOctree] = {}

    def encode(
        self, tick: MapTick, octrees: Mapping[str, SemanticOctree], num_robots: Mapping[str, int]
    ) -> Iterator[list[MapState]]:
        """Yield the next states, those of some octrees at a time: octrees of one tick, the means of ``num_robots``."""
        sequence = self._num_stored

        def encode(name: str) -> MapState:
            octree = octrees[name]
            # A robot that restarted has another octree, and a delta cannot remove bricks.
            is_key_frame = sequence % STATES_PER_KEY_FRAME == 0 or self._octrees[name] is not octree
            if is_key_frame:
                data = codec.encode_packet(octree)
            else:
                data = codec.encode_delta(octree, np.flatnonzero(octree.revisions > self.last_tick))
            base = sequence if is_key_frame else sequence - 1
            return MapState(
                name, tick.stamp_ns, tick.number, sequence, base, is_key_frame, data, tick.frame_ids[name],
                num_robots.get(name, 1),
            )  # fmt: skip

        names = list(octrees)
        for first in range(0, len(names), MAPS_AT_ONCE):
            yield list(self._threads.map(encode, names[first : first + MAPS_AT_ONCE]))
        self._num_stored += 1
        self._octrees = dict(octrees)
        self.last_tick = tick.number


class MapRecorder:
    """Recorder of maps; gives what a tick writes to a ``sink``. Maps are encoded in parallel ``threads``.

    ``warn`` is called with a sentence for each form of a map that cannot be stored.
    """

    def __init__(
        self, config: ResolvedRun, sink: MapSink, threads: Executor, warn: Callable[[str], None] = _log.warning
    ) -> None:
        self._config = config
        self._warn = warn
        self._sink = sink
        self._threads = threads
        self._maps = _StateSeries(threads)
        self._evidence = _StateSeries(threads)
        self._shown_ticks = dict.fromkeys(_SHOWN, -1)

    def state(self) -> dict[str, Any]:
        """Return what ``restore`` needs to continue after the last tick."""
        return {name: vars(self)[name] for name in ("_maps", "_evidence", "_shown_ticks")}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue a new recorder after the last tick of a ``state``."""
        vars(self).update(state)

    def record(self, tick: MapTick) -> None:
        """Store the maps of one tick where they are due."""
        output = self._config.output
        if self._is_due(tick, output.state_every):
            self._store_maps(tick)
        if output.evidence_every and self._is_due(tick, output.evidence_every):
            self._store_evidence(tick)
        for name, every in shown_periods(output).items():
            if self._is_due(tick, every):
                self._write_shown(name, tick)

    def finish(self, tick: MapTick) -> None:
        """Store the maps and the evidence of the last tick where they are not stored yet."""
        if self._maps.last_tick < tick.number:
            self._store_maps(tick)
        if self._evidence.last_tick < tick.number:
            self._store_evidence(tick)
        for name in shown_periods(self._config.output):
            if self._shown_ticks[name] < tick.number:
                self._write_shown(name, tick)

    def _is_due(self, tick: MapTick, every: float) -> bool:
        """True when a multiple of ``every`` seconds of log time lies in the period that ends with this tick."""
        return falls_due(tick.elapsed_ns, round(self._config.network.publish_period * 1e9), every)

    def _store_maps(self, tick: MapTick) -> None:
        """Store all maps."""
        for states in self._maps.encode(tick, tick.maps, tick.num_robots):
            self._write_each("write_state", [(state,) for state in states])

    def _store_evidence(self, tick: MapTick) -> None:
        """Store every robot's evidence."""
        for states in self._evidence.encode(tick, tick.evidence, {}):
            self._write_each("write_evidence", [(state,) for state in states])

    def _write_shown(self, name: str, tick: MapTick) -> None:
        """Store every robot's map in a form for other programs; maps that the form cannot hold are left out."""
        form = _SHOWN[name]

        def encode(robot_id: str) -> Any:
            try:
                return form.encode(tick.maps[robot_id], tick.num_robots[robot_id], self._config)
            except ValueError as error:
                # A map that cannot be encoded must not end a long run.
                self._warn(f"warning: robot '{robot_id}': no {name} is stored: {error}")
                return None

        robots = [robot_id for robot_id in tick.maps if robot_id != CENTRAL]
        for first in range(0, len(robots), MAPS_AT_ONCE):
            some = robots[first : first + MAPS_AT_ONCE]
            contents = zip(some, self._threads.map(encode, some), strict=True)
            self._write_each(
                form.write,
                [
                    (robot_id, tick.stamp_ns, content, tick.frame_ids[robot_id])
                    for robot_id, content in contents
                    if content is not None
                ],
            )
        self._shown_ticks[name] = tick.number

    def _write_each(self, write: str, rows: Sequence[tuple[Any, ...]]) -> None:
        """Start calls of ``write`` with the arguments of each row, after waiting for the calls before."""
        for row in rows:
            self._sink.add(write, *row)
        self._sink.start()
