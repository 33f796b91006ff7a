"""One run in tiles: each tile is replayed by itself, and the result is put together from all of them."""

from __future__ import annotations

import dataclasses
import functools
import logging
import math
import os
import resource
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np

from octoreplay import interrupts
from octoreplay.config.resolved import ResolvedRun
from octoreplay.config.rules import Exchanged
from octoreplay.config.run import RunConfig
from octoreplay.errors import ConfigError, InputError, MemoryLimitError
from octoreplay.io.containers.fingerprint import Fingerprint
from octoreplay.io.output_file import writing
from octoreplay.io.results.result_writer import ResultWriter
from octoreplay.io.robots.discover import resolve
from octoreplay.mapping.warm_up import second_compiler
from octoreplay.records import FilePath, FrameCounts
from octoreplay.replay.run import check_num_ticks, frame_causes
from octoreplay.run_metrics import RunSummary
from octoreplay.study.tiles.casting import cast_groups, cast_scans, team_start_ns
from octoreplay.study.tiles.cluster_workers import ClusterWorkers, check_cluster
from octoreplay.study.tiles.forecast import (
    BLOCK_CELLS,
    available_memory,
    check_joining,
    chosen_cells,
    join_memory,
    tile_memory,
    worker_memory,
)
from octoreplay.study.tiles.geometry import Tile, tile_cells, tiles_of
from octoreplay.study.tiles.joined_maps import JoinedMaps, OtherMaps
from octoreplay.study.tiles.scans import ScanFiles, ScanIndex, load_index, scan_bytes
from octoreplay.study.tiles.stage import Agreement, Stage, TileFiles
from octoreplay.study.tiles.tile_run import replay, settle
from octoreplay.study.tiles.work_folder import AGREEMENT, keep_tiles_of, work_folder
from octoreplay.study.tiles.worker import LocalWorkers, Request, Setup, Workers
from octoreplay.study.tiles.written import Outcome, write_result, write_tiles

_log = logging.getLogger(__name__)

_RETRY_SHARE = 0.7
"""Share of the forecast that was too low, into which the tiles of the next try must fit."""
_OTHER_FILES = 64
"""Open files of a process besides those of tiles."""

StartWorkers = Callable[[Setup], Workers]
"""Function that starts the workers of a run."""
Progress = Callable[[str, int, int], None]
"""Function that is called with a stage, and the numbers of finished robots, tiles, maps or ticks and of all."""


def replay_tiles(
    config: RunConfig,
    output: FilePath,
    edge: float | None = None,
    *,
    cut_heights: bool = False,
    num_jobs: int = 1,
    scheduler: str | None = None,
    num_threads: int | None = None,
    memory_limit: int | None = None,
    progress: Progress | None = None,
    result_per_tile: bool = False,
    restart: bool = False,
    resume: bool = False,
) -> RunSummary:
    """Replay a team's logs as ``replay_team`` does, one tile of the space after the other; the maps are the same.

    Parameters
    ----------
    config : RunConfig
        Configuration of the run.
    output : path
        Result to write.
    edge : float, optional
        Edge of the tiles along x and y [m], rounded to a power of two of cells. By default the
        tiles are the largest ones that fit into the memory by a forecast; where it was too low they are halved.
    cut_heights : bool
        Cut the heights too: tiles are cubes.
    num_jobs : int
        Number of tiles that are replayed at the same time, each in a process of its own.
    scheduler : str, optional
        Address of a dask scheduler such as ``tcp://host:8786``: tiles are replayed on its workers, which need the
        output's folder and the logs at the same paths.
    num_threads : int, optional
        Threads of each process; by default the processors are shared among the processes, and a process on a cluster
        has one.
    memory_limit : int, optional
        Largest memory of all processes together [byte], by default 80 % of what is free. On a cluster, that of one
        process; tiles of a given edge then need none.
    progress : function, optional
        Called with the stage ('cast', 'replay', 'settle', 'join', 'write tiles' or 'write'), and the numbers of
        finished robots, tiles, maps or ticks and of all.
    result_per_tile : bool
        True to write the maps of each tile into a result of its own in the folder ``OUT.maps`` beside the output, which
        is then the index of them: ``open_result`` reads both as one result. Cubes above each other share a result.
    restart, resume : bool
        Remove, or use, the tiles that an interrupted run has finished. Without either they are an error.

    Returns
    -------
    RunSummary
        Summary of the run. Sums of real numbers may differ from those of ``replay_team`` in the last digits. Packets
        are those of the tiles: the bytes of compressed packets are sums over the tiles.

    Raises
    ------
    ConfigError
        The tiles are too small or too large, or the configuration has what tiles cannot give: see
        ``check_separable``.
    MemoryLimitError
        A tile takes more memory than the limit leaves for it.
    InputError, OutputError
        As ``replay_team``; the tiles that are finished stay in the folder ``OUT.tiles`` beside the output.
    """
    started, output = time.monotonic(), Path(output)
    config = resolve(config)
    num_axes = 3 if cut_heights else 2
    given_cells = None if edge is None else tile_cells(edge, config.map.resolution)
    check_separable(config)
    check_num_ticks(config, config.total_ns)
    if scheduler is None:
        start_workers: StartWorkers = functools.partial(LocalWorkers, num_jobs=num_jobs)
        needs_limit = edge is None or memory_limit is not None
        room = worker_memory(memory_limit or available_memory(), num_jobs) if needs_limit else None
    else:
        check_cluster(scheduler, num_jobs, is_auto=edge is None, has_limit=memory_limit is not None)
        start_workers, room = functools.partial(ClusterWorkers, scheduler=scheduler), memory_limit
    num_threads = num_threads or (1 if scheduler else max(1, (os.cpu_count() or 1) // num_jobs))
    with ExitStack() as stack:
        stack.enter_context(second_compiler())
        writer = stack.enter_context(ResultWriter(output, config, restart=restart or resume))
        folder = stack.enter_context(work_folder(writer, given_cells, num_axes, restart=restart, resume=resume))
        robots = tuple(robot.with_absolute_paths() for robot in config.robots)
        setup = Setup(dataclasses.replace(config, robots=robots), folder.absolute(), num_threads, room)
        replayed = _replayed(
            setup, start_workers, given_cells, num_axes, writer.inputs, progress, joins=not result_per_tile
        )
        workers, scans, stages = stack.enter_context(replayed)
        tiles = tuple(stages)
        maps: JoinedMaps | OtherMaps
        outcome = Outcome.of(stages, _counts(config, scans, next(iter(stages.values())).num_frames_off))
        show = progress or (lambda *_: None)
        if result_per_tile:
            show_tiles = functools.partial(show, "write tiles")
            files, maps = write_tiles(output, tiles, workers, outcome, writer.inputs, show_tiles)
            writer.write_tiles(files)
        else:
            maps = JoinedMaps(config, tiles, folder)
            maps.encode_in(workers, join_memory(scans), functools.partial(show, "join"))
        with interrupts.deferred() as deliver_interrupts:

            def show_ticks(done: int) -> None:
                show("write", done, outcome.num_ticks)
                deliver_interrupts()

            summary = write_result(config, writer, maps, tiles, folder, outcome, num_threads, show_ticks)
            summary = dataclasses.replace(summary, wall_seconds=time.monotonic() - started)
            deliver_interrupts()
            writer.complete(summary)
        return summary


def check_separable(config: ResolvedRun) -> None:
    """Raise ConfigError where tiles of a run would depend on each other."""
    links = [config.link, *(config.link_config(sender, receiver) for sender, receiver, _ in config.link_overrides)]
    draws = any(link.mean_loss > 0.0 or link.jitter > 0.0 or link.corruption > 0.0 for link in links)
    reasons = {
        "align on-air": config.alignment.is_on_air,
        "rate": any(link.rate is not None for link in links),
        "budget": config.effective_packet.budget is not None,
        "prune_tolerance": config.map.prune_tolerance > 0.0,
        "keep_packets": config.output.keep_packets,
        f"rule {config.consensus.rule} with losses, jitter or corruption": draws
        and config.consensus.traits.exchanges is Exchanged.EVIDENCE,
    }
    for name, applies in reasons.items():
        if applies:
            raise ConfigError(f"tiles: cannot be used with {name}, which needs the packets of the whole map at once")


def _allow_open_files(num_tiles: int) -> None:
    """Let this process open the files of all tiles. Raises ConfigError where the system does not allow it."""
    wanted = num_tiles + _OTHER_FILES
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard != resource.RLIM_INFINITY and wanted > hard:
        raise ConfigError(
            f"tiles: {num_tiles:,} tiles need more open files than the {hard:,} that the system allows; give a larger"
            " edge, or raise 'ulimit -n'"
        )
    if soft != resource.RLIM_INFINITY and wanted > soft:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


@contextmanager
def _replayed(
    setup: Setup,
    start_workers: StartWorkers,
    given_cells: int | None,
    num_axes: int,
    inputs: Mapping[str, Fingerprint],
    progress: Progress | None,
    *,
    joins: bool,
) -> Iterator[tuple[Workers, list[ScanIndex], dict[Tile, Stage]]]:
    """Replay all tiles up to their last tick, with a given edge or with the largest one that fits into the memory.

    Yields the workers, the index of the scans of each robot, and the tiles in ascending order. ``joins`` is True where
    each robot's map is joined.
    """
    room: float = setup.memory_limit or math.inf
    while True:
        with start_workers(setup) as workers:
            scans = _cast_scans(setup, workers, given_cells or BLOCK_CELLS, num_axes, inputs, progress)
            if joins:
                check_joining(scans, room)
            num_cells = given_cells or chosen_cells(setup.config, scans, room)
            tiles = _tiles(setup.config, scans, num_cells)
            _allow_open_files(len(tiles))
            keep_tiles_of(setup.folder, num_cells)
            memory = tile_memory(setup.config, scans, num_cells)
            try:
                stages = _replay_all(setup, workers, tiles, memory, progress)
            except MemoryLimitError as error:
                if given_cells is not None:
                    raise
                _log.info("%s; the run goes on with smaller tiles", str(error).partition(";")[0])
                room = _RETRY_SHARE * memory
                continue
            yield workers, scans, stages
            return


def _cast_scans(
    setup: Setup, workers: Workers, block_cells: int, num_axes: int, inputs: Mapping[str, Fingerprint],
    progress: Progress | None,
) -> list[ScanIndex]:  # fmt: skip
    """Cast the scans of all robots that an earlier run has not cast; return the index of each robot."""
    config, folder = setup.config, setup.folder
    start_ns, groups = team_start_ns(config), cast_groups(config, folder, setup.num_threads)
    names = [", ".join(config.robots[index].robot_id for index in group) for group in groups]
    requests = [
        Request(name, cast_scans, (group, start_ns, block_cells, num_axes, inputs))
        for name, group in zip(names, groups, strict=True)
    ]
    num_done = len(config.robots) - sum(map(len, groups))
    for num_robots in workers.answers(requests):
        num_done += num_robots
        if progress is not None:
            progress("cast", num_done, len(config.robots))
    paths = [ScanFiles(folder, index).index for index in range(len(config.robots))]
    scans = [load_index(path) for path in paths]
    if not sum(index.frames.size for index in scans):
        # They are of no use to a run that continues this one.
        with writing(folder):
            for path in paths:
                path.unlink()
    return scans


def _tiles(config: ResolvedRun, scans: Sequence[ScanIndex], num_cells: int) -> dict[Tile, int]:
    """Tiles that the scans touch, in ascending order, with the bytes of their scans. Raises InputError without any."""
    if not sum(index.stamps.size for index in scans):
        causes = frame_causes(_counts(config, scans, [{}] * len(scans)), config.time)
        raise InputError(f"no robot has a frame that can be used: {causes}")
    blocks = np.concatenate([index.blocks for index in scans])
    tiles = tiles_of(blocks, num_cells // scans[0].block_cells, num_cells)
    if not tiles:
        raise InputError("bounds: no ray of any frame passes them; check bounds and the robots' poses")
    return dict(zip(tiles, scan_bytes(scans, num_cells), strict=True))


def _counts(
    config: ResolvedRun, scans: Sequence[ScanIndex], num_frames_off: Sequence[Mapping[int, int]]
) -> dict[str, FrameCounts]:
    """Counts of each robot's messages by robot_id; ``num_frames_off`` were left out because the robot was off."""
    return {
        robot.robot_id: index.counts.total(num_off)
        for robot, index, num_off in zip(config.robots, scans, num_frames_off, strict=True)
    }


def _replay_all(
    setup: Setup, workers: Workers, tiles: Mapping[Tile, int], memory: int, progress: Progress | None
) -> dict[Tile, Stage]:
    """Replay all tiles, those with the most scans first, until all have settled with the same number of ticks.

    A tile settles at once with the values of the tiles that are finished. They are right for all tiles unless a later
    tile has larger log-odds or takes longer; settling then goes on in rounds.
    """
    config, folder = setup.config, setup.folder
    stages = {tile: stage for tile in tiles if (stage := TileFiles(folder, tile).read_stage()) is not None}
    if stages:
        _log.info("%d of %d tiles were finished before", len(stages), len(tiles))
    else:
        with writing(folder):
            (folder / AGREEMENT).unlink(missing_ok=True)
    left = sorted((tile for tile in tiles if tile not in stages), key=lambda tile: -tiles[tile])
    requests = [Request(tile.name, replay, (tile,), memory) for tile in left]
    agreement = _agreement(config, folder, stages, None)
    kind, num_done = "replay", len(stages)
    while True:
        for tile, stage in workers.answers(requests):
            stages[tile] = stage
            agreement, num_done = _agreement(config, folder, stages, agreement), num_done + 1
            if progress is not None:
                progress(kind, num_done, len(tiles))
        assert agreement is not None
        left = [tile for tile in tiles if not stages[tile].is_complete(config, agreement)]
        if not left:
            return {tile: stages[tile] for tile in tiles}
        requests = [Request(tile.name, settle, (tile, agreement), memory) for tile in left]
        kind, num_done = "settle", len(tiles) - len(left)


def _agreement(
    config: ResolvedRun, folder: Path, stages: Mapping[Tile, Stage], known: Agreement | None
) -> Agreement | None:
    """Agreement of the finished tiles, stored for the workers where it is not the ``known`` one; None without tiles."""
    if not stages:
        return None
    agreement = Agreement.of(config, stages.values())
    if agreement != known:
        agreement.save(folder)
    return agreement
