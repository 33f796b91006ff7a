"""One run in tiles: each tile is replayed by itself, and the result is put together from all of them."""

from __future__ import annotations

import dataclasses
import json
import logging
import os
import resource
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from octoreplay import interrupts
from octoreplay.config.resolved import ResolvedRun
from octoreplay.config.rules import Exchanged
from octoreplay.config.run import RunConfig
from octoreplay.errors import ConfigError, InputError, OutputError
from octoreplay.io.output_file import write_whole, writing
from octoreplay.io.results.result_writer import ResultWriter
from octoreplay.io.robots.discover import resolve
from octoreplay.mapping.warm_up import second_compiler
from octoreplay.records import FilePath
from octoreplay.replay.run import check_num_ticks, frame_causes
from octoreplay.run_metrics import RunSummary
from octoreplay.study.tiles.geometry import Tile, tile_cells, tiles_of
from octoreplay.study.tiles.joined_maps import JoinedMaps, OtherMaps
from octoreplay.study.tiles.survey import Survey
from octoreplay.study.tiles.tile_run import Stage, TileFiles, replay_logs, settle
from octoreplay.study.tiles.worker import Request, Setup, Workers
from octoreplay.study.tiles.written import Outcome, write_result, write_tiles

_log = logging.getLogger(__name__)

_DESCRIPTION = "run.json"
_OTHER_FILES = 64
"""Open files of a process besides those of tiles."""

Progress = Callable[[str, int, int], None]
"""Function that is called with a stage, and the numbers of finished tiles or ticks and of all."""


def replay_tiles(
    config: RunConfig,
    output: FilePath,
    edge: float,
    *,
    num_jobs: int = 1,
    num_threads: int | None = None,
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
    edge : float
        Edge of the tiles along x and y [m], rounded to a power of two of cells. Tiles have all heights.
    num_jobs : int
        Number of tiles that are replayed at the same time, each in a process of its own.
    num_threads : int, optional
        Threads of each process; by default the processors are shared among the processes.
    progress : function, optional
        Called with the stage ('replay', 'settle', 'write tiles' or 'write'), and the numbers of finished tiles or ticks
        and of all.
    result_per_tile : bool
        True to write the maps of each tile into a result of its own in the folder ``OUT.maps`` beside the output, which
        is then the index of them: ``open_result`` reads both as one result.
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
        The tiles are too small, or the configuration has what tiles cannot give: see ``check_separable``.
    InputError, OutputError
        As ``replay_team``; the tiles that are finished stay in the folder ``OUT.tiles`` beside the output.
    """
    started, output = time.monotonic(), Path(output)
    config = resolve(config)
    num_cells = tile_cells(edge, config.map.resolution)
    check_separable(config)
    check_num_ticks(config, config.total_ns)
    num_threads = num_threads or max(1, (os.cpu_count() or 1) // num_jobs)
    with ExitStack() as stack:
        stack.enter_context(second_compiler())
        writer = stack.enter_context(ResultWriter(output, config, restart=restart or resume))
        folder = stack.enter_context(_work_folder(writer, num_cells, restart=restart, resume=resume))
        survey = Survey(config)
        if not len(survey.boxes):
            raise InputError(f"no robot has a frame that can be used: {frame_causes(survey.counts(), config.time)}")
        tiles = tiles_of(survey.boxes, num_cells, config)
        if not tiles:
            raise InputError("bounds: no ray of any frame passes them; check bounds and the robots' poses")
        _allow_open_files(len(tiles))
        survey.save(folder)
        workers = stack.enter_context(Workers(Setup(config, folder, num_threads), num_jobs))
        stages = _replay_logs(tiles, workers, folder, progress)
        stages = _settle(tiles, stages, workers, progress)
        outcome = Outcome.of(stages, survey.counts(next(iter(stages.values())).num_frames_off))
        show = progress or (lambda *_: None)
        maps: JoinedMaps | OtherMaps = JoinedMaps(config, tiles, folder)
        if result_per_tile:
            files, maps = write_tiles(
                output, tiles, workers, outcome, writer.inputs, lambda done: show("write tiles", done, len(tiles))
            )
            writer.write_tiles(files)
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
def _work_folder(writer: ResultWriter, num_cells: int, *, restart: bool, resume: bool) -> Iterator[Path]:
    """Folder of the work files; after an error it is kept if a tile is finished, and a note of the error names it.

    Raises OutputError, InputError and ConfigError where an earlier run left a folder that cannot be used.
    """
    folder = writer.path.with_name(f"{writer.path.stem}.tiles")
    description = {**writer.description, "tiles": {"cells": str(num_cells)}}
    with writing(folder):
        if folder.exists() and not (restart or resume):
            raise OutputError(
                f"{folder}: an earlier run left these tiles; continue it with --resume, or remove them and start again"
                " with --restart"
            )
        continues = resume and (folder / _DESCRIPTION).exists()
        if not continues:
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
    if continues:
        _check_same(writer, folder / _DESCRIPTION, description)
    else:
        write_whole(folder / _DESCRIPTION, json.dumps(description))
    try:
        yield folder
    except BaseException as error:
        if any(folder.glob("tile_*.json")):
            error.add_note(f"the finished tiles are in {folder}; --resume continues the run")
        elif not continues:
            shutil.rmtree(folder, ignore_errors=True)
        raise
    shutil.rmtree(folder, ignore_errors=True)


def _check_same(writer: ResultWriter, path: Path, description: Mapping[str, Mapping[str, str]]) -> None:
    """Raise ConfigError where the tiles of an earlier run are those of other settings."""
    try:
        earlier = json.loads(path.read_text(encoding="utf-8"))
        tiles = earlier["tiles"]
    except (OSError, ValueError, KeyError) as error:
        raise InputError(f"{path}: cannot be read; run with --restart to start from the beginning") from error
    if tiles != description["tiles"]:
        raise ConfigError(
            f"{writer.path}: cannot be continued: the tiles had another edge; use the same --tiles, or run with"
            " --restart to start from the beginning"
        )
    writer.check_same(earlier)


def _replay_logs(tiles: Sequence[Tile], workers: Workers, folder: Path, progress: Progress | None) -> dict[Tile, Stage]:
    """Replay the logs of all tiles that an earlier run has not finished."""
    stages = {tile: stage for tile in tiles if (stage := TileFiles(folder, tile).read_stage()) is not None}
    if stages:
        _log.info("%d of %d tiles were finished before", len(stages), len(tiles))
    requests = [Request(tile.name, replay_logs, (tile,)) for tile in tiles if tile not in stages]
    for tile, stage in workers.answers(requests):
        stages[tile] = stage
        if progress is not None:
            progress("replay", len(stages), len(tiles))
    return stages


def _settle(
    tiles: Sequence[Tile], stages: dict[Tile, Stage], workers: Workers, progress: Progress | None
) -> dict[Tile, Stage]:
    """Let all tiles settle, in rounds, until all have the same number of ticks.

    A team has settled where all its tiles have, so every tile goes on until the last one has settled.
    """
    largest = max(stage.largest for stage in stages.values())
    while True:
        least = max(stage.num_settling for stage in stages.values())
        left = [tile for tile in tiles if not stages[tile].stop_reason or stages[tile].num_settling < least]
        if not left:
            return stages
        num_done = len(tiles) - len(left)
        requests = [Request(tile.name, settle, (tile, largest, least)) for tile in left]
        for tile, stage in workers.answers(requests):
            stages[tile] = stage
            num_done += 1
            if progress is not None:
                progress("settle", num_done, len(tiles))
