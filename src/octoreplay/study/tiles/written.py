"""Results of a run in tiles: one of the whole run, or one of each tile and an index of them."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from octoreplay.config.resolved import ResolvedRun
from octoreplay.io.containers.fingerprint import Fingerprint
from octoreplay.io.results.result_writer import ResultWriter
from octoreplay.io.results.tile_files import TileFile, TileList, put_file
from octoreplay.records import CONVERGED, FrameCounts
from octoreplay.replay.team_recorder import TeamRecorder
from octoreplay.replay.warnings import (
    coverage_warnings,
    map_warnings,
    packet_warnings,
    rule_warnings,
    team_frame_warnings,
)
from octoreplay.run_metrics import RunSummary
from octoreplay.study.tiles.geometry import Tile
from octoreplay.study.tiles.joined_maps import JoinedMaps, OtherMaps
from octoreplay.study.tiles.joined_ticks import joined_ticks
from octoreplay.study.tiles.stage import Stage
from octoreplay.study.tiles.worker import Request, Setup, Workers


@dataclass(frozen=True)
class Outcome:
    """End of a run: number of ticks, reason, whether all links carried both ways alike, and counts of frames."""

    num_ticks: int
    stop_reason: str
    is_symmetric: bool
    counts: Mapping[str, FrameCounts]

    @classmethod
    def of(cls, stages: Mapping[Tile, Stage], counts: Mapping[str, FrameCounts]) -> Outcome:
        """Return the end of a run whose tiles are complete."""
        first = next(iter(stages.values()))
        # A tile that has not settled stands for the team.
        reasons = {stage.stop_reason for stage in stages.values()}
        return cls(first.num_ticks, next(iter(reasons - {CONVERGED}), CONVERGED), first.is_symmetric, counts)


def write_result(
    config: ResolvedRun, writer: ResultWriter, maps: JoinedMaps | OtherMaps, tiles: Sequence[Tile], folder: Path,
    outcome: Outcome, num_threads: int, show: Callable[[int], None] = lambda _: None,
) -> RunSummary:  # fmt: skip
    """Write all ticks and maps of a run, or of one of its tiles, and return its summary without the wall time.

    The maps are encoded.
    ``show`` is called with the number of ticks that are written.
    """
    with ThreadPoolExecutor(num_threads) as threads, TeamRecorder(config, writer, threads) as recorder:
        show(0)
        written_maps = maps.write(recorder.queue)
        for tick in joined_ticks(config, tiles, folder):
            recorder.record(tick.metrics, tick.graph, tick.poses)
            next(written_maps)
            recorder.queue.start()
            show(tick.metrics.tick + 1)
        assert recorder.last is not None
        warnings = (
            *config.warnings,
            *rule_warnings(config, outcome.is_symmetric),
            *packet_warnings(config),
            *map_warnings(recorder.last.num_known_cells),
            *team_frame_warnings(recorder.last, {name: n for name, n in maps.num_evidence_cells.items() if n}),
            *coverage_warnings(outcome.counts),
        )
        return recorder.finish(outcome.stop_reason, outcome.counts, warnings, math.nan)


def write_tiles(
    output: Path, tiles: Sequence[Tile], workers: Workers, outcome: Outcome, inputs: Mapping[str, Fingerprint],
    show: Callable[[int, int], None],
) -> tuple[TileList, OtherMaps]:  # fmt: skip
    """Write the result of each column of tiles into the folder of a result.

    ``show`` is called with the numbers of written columns and of all; ``inputs`` are the fingerprints of the logs.
    Raises InputError and OutputError.
    """
    columns: dict[Tile, list[Tile]] = {}
    for tile in tiles:
        columns.setdefault(tile._replace(z=None), []).append(tile)
    files: dict[Tile, TileFile] = {}
    num_cells: Counter[str] = Counter()
    requests = [
        Request(column.name, write_column, (column, some, outcome, dict(inputs))) for column, some in columns.items()
    ]
    for column, path, of_column in workers.answers(requests):
        files[column] = put_file(path, output, column.x, column.y)
        num_cells.update(of_column)
        show(len(files), len(columns))
    return TileList(tiles[0].num_cells, tuple(files[column] for column in columns)), OtherMaps(num_cells)


def write_column(
    setup: Setup, column: Tile, tiles: Sequence[Tile], outcome: Outcome, inputs: Mapping[str, Fingerprint]
) -> tuple[Tile, Path, dict[str, int]]:
    """Write the result of the tiles in one column, as a request to a worker.

    Return the column, the file, and the known cells of each robot's evidence.
    """
    config, path = column.config(setup.config), setup.folder / f"{column.name}.mcap"
    maps = JoinedMaps(config, tiles, setup.folder)
    maps.encode(setup.num_threads)
    with ResultWriter(path, config, restart=True, inputs=inputs) as writer:
        writer.complete(write_result(config, writer, maps, tiles, setup.folder, outcome, setup.num_threads))
    return column, path, maps.num_evidence_cells
