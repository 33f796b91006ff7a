"""Replay of one tile of a run: its logs, and settling up to a tick on which all tiles agree."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from typing import Any, Self

import numpy as np

from octoreplay.config.resolved import ResolvedRun
from octoreplay.errors import InputError, MemoryLimitError
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
from octoreplay.study.tiles.stage import Agreement, Stage, TileFiles
from octoreplay.study.tiles.work import StoredMap, TileTick, WorkFile
from octoreplay.study.tiles.worker import Setup

MAPS, EVIDENCE = "maps", "evidence"
"""Kinds of stored maps."""


class TileRun:
    """Replay of one tile in its own process.

    Both methods raise ConfigError, InputError and OutputError, and MemoryLimitError above the limit of a worker.
    """

    def __init__(self, setup: Setup, tile: Tile) -> None:
        self._setup = setup
        self._config = tile.config(setup.config)
        self._tile = tile
        self._files = TileFiles(setup.folder, tile)

    def replay(self, agreement: Agreement | None = None) -> Stage:
        """Replay all scans, and settle where an ``agreement`` is given or in the work folder, or none is needed."""
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
                largest = session.largest_log_odds
                agreement = agreement or Agreement.load(self._setup.folder)
                if agreement is None and config.effective_flow_bits:
                    # Flows of all tiles get finer alike, and no other tile is finished.
                    return self._pause(session, recorder, 0, largest, None)
                agreement = (agreement or Agreement(largest, 0)).with_tile(config, largest)
                return self._settle(session, recorder, 0, largest, agreement)

    def settle(self, agreement: Agreement) -> Stage:
        """Settle until the tile has settled as the ``agreement`` says; goes on from the last stage where it can."""
        stage = self._files.read_stage()
        if stage is None:
            raise InputError(f"{self._files.stage}: is missing, as after a kill while it was saved; give --resume")
        if stage.num_finer not in (None, agreement.num_finer(self._config)):
            return self.replay(agreement)
        with ThreadPoolExecutor(self._setup.num_threads) as threads:
            session = Session(self._config, (), threads, tile_cells=self._tile.num_cells)
            content = load_state(self._files.state, session.shared)
            session.restore(content["session"])
            with _TileRecorder(self._config, self._files, stage.lengths, content["stored"]) as recorder:
                return self._settle(session, recorder, stage.num_settling, stage.largest, agreement)

    def _settle(
        self, session: Session, recorder: _TileRecorder, num_settling: int, largest: float, agreement: Agreement
    ) -> Stage:
        """Settle; ``largest`` is the largest |log-odds| of this tile at the end of the logs."""
        for tick in session.settling_ticks(agreement.largest, agreement.least_ticks):
            num_settling += 1
            recorder.record(tick)
            self._check_memory()
        return self._pause(session, recorder, num_settling, largest, agreement.num_finer(self._config))

    def _check_memory(self) -> None:
        """Raise MemoryLimitError above the limit of a worker."""
        limit, used = self._setup.memory_limit, resident_bytes()
        if limit is not None and used > limit:
            raise MemoryLimitError(
                f"{self._tile.name}: takes {used / 1e9:.3g} GB, more than the {limit / 1e9:.3g} GB of a process;"
                " continue with --resume and a larger --memory-limit, or give a smaller --tiles"
            )

    def _pause(
        self, session: Session, recorder: _TileRecorder, num_settling: int, largest: float, num_finer: int | None
    ) -> Stage:
        """Save the state, from which the next stage continues, and the maps of a tile that has settled."""
        lengths = recorder.flush()
        # The stage describes the other files only once they are complete.
        self._files.stage.unlink(missing_ok=True)
        if num_finer is not None:
            with WorkFile(self._files.last_maps, 0) as file:
                for stored in recorder.last_maps(session):
                    file.write_map(stored)
                file.flush()
        save_state(self._files.state, {"session": session.state(), "stored": recorder.stored}, session.shared)
        stage = Stage(
            session.num_ticks, num_settling, lengths, largest, num_finer, session.stop_reason,
            session.is_symmetric, session.num_frames_off,
        )  # fmt: skip
        stage.save(self._files.stage)
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


def replay(setup: Setup, tile: Tile) -> tuple[Tile, Stage]:
    """Replay the logs in one tile, and let it settle where that is possible, as a request to a worker."""
    return tile, TileRun(setup, tile).replay()


def settle(setup: Setup, tile: Tile, agreement: Agreement) -> tuple[Tile, Stage]:
    """Let one tile settle, as a request to a worker."""
    return tile, TileRun(setup, tile).settle(agreement)
