"""Replay of one tile of a run, in stages: its logs, and settling up to a tick on which all tiles agree."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np

from octoreplay.config.resolved import ResolvedRun
from octoreplay.errors import InputError, MemoryLimitError
from octoreplay.io.output_file import write_whole
from octoreplay.mapping import codec
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.records import CENTRAL
from octoreplay.replay.checkpoint import load_state, save_state
from octoreplay.replay.map_recorder import map_periods
from octoreplay.replay.memory import resident_bytes
from octoreplay.replay.session import Session
from octoreplay.replay.tick import Tick, falls_due
from octoreplay.study.tiles.geometry import Tile
from octoreplay.study.tiles.scans import ScanFile, ScanFiles
from octoreplay.study.tiles.work import StoredMap, TileTick, WorkFile
from octoreplay.study.tiles.worker import Setup

MAPS, EVIDENCE = "maps", "evidence"
"""Kinds of stored maps."""


@dataclass(frozen=True)
class Stage:
    """Progress of a tile.

    Attributes
    ----------
    num_ticks, num_settling : int
        Ticks, and those of them in which the tile settled.
    lengths : (int, int)
        Lengths of the files of ticks and of maps [byte].
    largest : float
        Largest |log-odds| of any map at the end of the logs.
    stop_reason : str
        Reason for the end; empty before settling.
    is_symmetric : bool
        True where all links carried both ways with the same weight.
    num_frames_off : list of dict
        Frames that were left out because the schedule had the robot off, by robot and sensor.
    """

    num_ticks: int
    num_settling: int
    lengths: tuple[int, int]
    largest: float
    stop_reason: str
    is_symmetric: bool
    num_frames_off: list[dict[int, int]]


class TileFiles:
    """Paths of the work files of a tile in a folder."""

    def __init__(self, folder: Path, tile: Tile) -> None:
        self.ticks = folder / f"{tile.name}.ticks"
        self.maps = folder / f"{tile.name}.maps"
        self.last_maps = folder / f"{tile.name}.last"
        self.state = folder / f"{tile.name}.state"
        self.stage = folder / f"{tile.name}.json"

    def read_stage(self) -> Stage | None:
        """Return the progress of the tile; None where it has not finished its logs."""
        try:
            values = json.loads(self.stage.read_text(encoding="utf-8"))
            values["num_frames_off"] = [{int(k): n for k, n in off.items()} for off in values["num_frames_off"]]
            values["lengths"] = tuple(values["lengths"])
            stage = Stage(**values)
            sizes = self.ticks.stat().st_size, self.maps.stat().st_size
        except (OSError, ValueError, TypeError, KeyError):
            return None
        is_whole = self.state.exists() and all(size >= n for size, n in zip(sizes, stage.lengths, strict=True))
        return stage if is_whole else None


class TileRun:
    """Replay of one tile in its own process.

    Both methods raise ConfigError, InputError and OutputError, and MemoryLimitError above the limit of a worker.
    """

    def __init__(self, setup: Setup, tile: Tile) -> None:
        self._setup = setup
        self._config = tile.config(setup.config)
        self._tile = tile
        self._files = TileFiles(setup.folder, tile)

    def replay_logs(self) -> Stage:
        """Replay all scans."""
        config = self._config
        with ExitStack() as stack:
            sources = [
                stack.enter_context(ScanFile(ScanFiles(self._setup.folder, index), robot.robot_id, self._tile))
                for index, robot in enumerate(config.robots)
            ]
            threads = stack.enter_context(ThreadPoolExecutor(self._setup.num_threads))
            session = Session(config, sources, threads, tile_cells=self._tile.num_cells)
            with _TileRecorder(config, self._files) as recorder:
                for tick in session.log_ticks():
                    recorder.record(tick)
                    self._check_memory()
                return self._pause(session, recorder, 0, session.largest_log_odds)

    def settle(self, largest: float, least_ticks: int) -> Stage:
        """Settle until the tile has settled, for at least ``least_ticks`` in all; ``largest`` is that of all tiles."""
        stage = self._files.read_stage()
        if stage is None:
            raise InputError(f"{self._files.stage}: is missing, as after a kill while it was saved; give --resume")
        with ThreadPoolExecutor(self._setup.num_threads) as threads:
            session = Session(self._config, (), threads, tile_cells=self._tile.num_cells)
            content = load_state(self._files.state, session.shared)
            session.restore(content["session"])
            num_settling = stage.num_settling
            with _TileRecorder(self._config, self._files, stage.lengths, content["stored"]) as recorder:
                for tick in session.settling_ticks(largest, least_ticks):
                    num_settling += 1
                    recorder.record(tick)
                    self._check_memory()
                return self._pause(session, recorder, num_settling, stage.largest)

    def _check_memory(self) -> None:
        """Raise MemoryLimitError above the limit of a worker."""
        limit, used = self._setup.memory_limit, resident_bytes()
        if limit is not None and used > limit:
            raise MemoryLimitError(
                f"{self._tile.name}: takes {used / 1e9:.3g} GB, more than the {limit / 1e9:.3g} GB of a process;"
                " continue with --resume and a larger --memory-limit, or give a smaller --tiles"
            )

    def _pause(self, session: Session, recorder: _TileRecorder, num_settling: int, largest: float) -> Stage:
        """Save the state, from which the next stage continues, and the maps, in case that it is the last one."""
        lengths = recorder.flush()
        # The stage describes the other files only once they are complete.
        self._files.stage.unlink(missing_ok=True)
        with WorkFile(self._files.last_maps, 0) as file:
            for stored in recorder.last_maps(session):
                file.write_map(stored)
            file.flush()
        save_state(self._files.state, {"session": session.state(), "stored": recorder.stored}, session.shared)
        stage = Stage(
            session.num_ticks, num_settling, lengths, largest, session.stop_reason,
            session.is_symmetric, session.num_frames_off,
        )  # fmt: skip
        write_whole(self._files.stage, json.dumps(asdict(stage)))
        return stage


class _TileRecorder:
    """Recorder of the ticks and maps of a tile, after the first ``lengths`` bytes of its files; a context manager.

    ``stored`` is its state, which refers to octrees of the session.
    """

    def __init__(
        self,
        config: ResolvedRun,
        files: TileFiles,
        lengths: tuple[int, int] = (0, 0),
        stored: dict[str, Any] | None = None,
    ) -> None:
        self._output = config.output
        self._period_ns = round(config.network.publish_period * 1e9)
        self.stored: dict[str, Any] = stored or {"start_ns": None, MAPS: (-1, {}), EVIDENCE: (-1, {})}
        with ExitStack() as stack:
            self._ticks = stack.enter_context(WorkFile(files.ticks, lengths[0]))
            self._maps = stack.enter_context(WorkFile(files.maps, lengths[1]))
            self._closing = stack.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._closing.close()

    def record(self, tick: Tick) -> None:
        """Write one tick, and the maps that are due in it."""
        if self.stored["start_ns"] is None:
            self.stored["start_ns"] = tick.stamp_ns
        names = tick.graph.robot_ids
        self._ticks.write_tick(TileTick(tick.number, tick.stamp_ns, tick.settling, tick.graph, tick.poses, tick.counts))
        if self._is_due(tick, map_periods(self._output)):
            maps = dict(zip((*names, CENTRAL), (*tick.maps, tick.oracle), strict=True))
            self._write(self._changes(MAPS, tick.number, maps))
        if self._output.evidence_every and self._is_due(tick, (self._output.evidence_every,)):
            self._write(self._changes(EVIDENCE, tick.number, dict(zip(names, tick.evidence, strict=True))))

    def last_maps(self, session: Session) -> Iterator[StoredMap]:
        """Yield the changes of all maps and evidence up to the last tick; they do not count as stored."""
        stored, number = dict(self.stored), session.num_ticks - 1
        yield from self._changes(MAPS, number, session.maps)
        yield from self._changes(EVIDENCE, number, session.evidence)
        self.stored = stored

    def flush(self) -> tuple[int, int]:
        """Return the lengths of the files, which hold everything that was recorded."""
        return self._ticks.flush(), self._maps.flush()

    def _write(self, changes: Iterable[StoredMap]) -> None:
        for stored in changes:
            self._maps.write_map(stored)

    def _changes(self, kind: str, number: int, octrees: Mapping[str, SemanticOctree]) -> Iterator[StoredMap]:
        """Yield the changes of octrees by name since they were stored before, and note that they are stored now."""
        last_tick, before = self.stored[kind]
        self.stored[kind] = (number, dict(octrees))
        for name, octree in octrees.items():
            # A robot that restarted has another octree.
            is_new = before.get(name) is not octree
            bricks = np.arange(octree.num_bricks) if is_new else np.flatnonzero(octree.revisions > last_tick)
            yield StoredMap(number, kind == EVIDENCE, name, is_new, codec.encode_delta(octree, bricks))

    def _is_due(self, tick: Tick, periods: Iterable[float]) -> bool:
        elapsed_ns = tick.stamp_ns - self.stored["start_ns"]
        return any(falls_due(elapsed_ns, self._period_ns, every) for every in periods)


def replay_logs(setup: Setup, tile: Tile) -> tuple[Tile, Stage]:
    """Replay the logs in one tile, as a request to a worker."""
    return tile, TileRun(setup, tile).replay_logs()


def settle(setup: Setup, tile: Tile, largest: float, least_ticks: int) -> tuple[Tile, Stage]:
    """Let one tile settle, as a request to a worker."""
    return tile, TileRun(setup, tile).settle(largest, least_ticks)
