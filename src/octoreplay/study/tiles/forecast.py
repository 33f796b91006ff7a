"""Forecast of the memory that a run takes, whole or in tiles, and the tiles that fit into a limit."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from octoreplay.config.resolved import ResolvedRun
from octoreplay.config.rules import Exchanged
from octoreplay.errors import ConfigError
from octoreplay.io.robots.read_ahead import ReadAhead
from octoreplay.mapping.octree import brick_keys
from octoreplay.mapping.sensor import ScanCaster
from octoreplay.records import Int64Array
from octoreplay.replay.memory import free_bytes
from octoreplay.replay.sources import TeamSources
from octoreplay.study.tiles.geometry import LEAST_CELLS
from octoreplay.study.tiles.scans import SAMPLE, ScanIndex, is_sampled

_log = logging.getLogger(__name__)

PROCESS_BYTES = 250_000_000
"""Memory of a process without any map."""
ROBOT_BYTES = 10_000_000
"""Memory for each robot, without its maps."""
EVIDENCE_BYTES = 600
"""Memory of a brick of one robot's evidence, and of the centralised map."""
MAP_BYTES = {Exchanged.MAP: 1200, Exchanged.RUNNING_SUMS: 2200, Exchanged.EVIDENCE: 750, Exchanged.NOTHING: 0}
"""Memory of a brick of one robot's map, with the versions that it and its neighbours hold, by what robots exchange."""
MARGIN = 1.2
"""Factor on the forecast for a tile, which also holds what joins it to the others."""
JOIN_BYTES = 1400
"""Memory of a brick of the team's map while one robot's map and evidence are joined and encoded."""
FREE_SHARE = 0.8
"""Share of the free memory that a run without a limit may take."""
BLOCK_CELLS = 2 * LEAST_CELLS
"""Edge of the blocks that divide the scans of a run whose tiles are chosen after them."""

_SAMPLE_SECONDS = 2.0
_LEAST_FRAMES = 20


class Bricks(NamedTuple):
    """Numbers of bricks: the sum over the robots of those that each one sees, and those that any robot sees."""

    own: float
    union: float

    def memory(self, config: ResolvedRun) -> int:
        """Return the memory of a process that replays these bricks [byte]."""
        num_robots, of_map = len(config.robots), MAP_BYTES[config.consensus.traits.exchanges]
        # The map of a robot that exchanges nothing has the bricks of its evidence.
        of_robots = of_map * self.union * num_robots if of_map else EVIDENCE_BYTES * self.own
        return round(
            PROCESS_BYTES + ROBOT_BYTES * num_robots + EVIDENCE_BYTES * (self.own + self.union) + of_robots
        )  # fmt: skip


def takes_tiles(config: ResolvedRun, limit: int) -> bool:
    """Return True where a run takes more memory than ``limit`` [byte], but less in tiles. Raises InputError."""
    if MARGIN * Bricks(0.0, 0.0).memory(config) > worker_memory(limit, 1):
        return False
    memory = whole_memory(config)
    if memory > limit:
        _log.info("the run takes about %.2g GB and is replayed in tiles", memory / 1e9)
    return memory > limit


def whole_memory(config: ResolvedRun) -> int:
    """Return the memory of a run without tiles [byte], from a sample of the scans.

    About one scan in two seconds of each robot is cast, at least 20. The number of all bricks is estimated from those
    seen once and twice: D + f1 (f1 - 1) / (2 (f2 + 1)), of D bricks f1 in one scan and f2 in two (Chao, 'Estimating the
    population size for capture-recapture data with unequal catchability', Biometrics 43, 1987). Raises InputError.
    """
    seconds = None if config.total_ns is None else config.total_ns / 1e9
    rate = max(1 / _SAMPLE_SECONDS, _LEAST_FRAMES / seconds if seconds else 0.0)
    rate = min(rate, config.time.rate_limit or np.inf)
    thinned = dataclasses.replace(config, time=dataclasses.replace(config.time, rate_limit=rate))
    with TeamSources(thinned) as team, ThreadPoolExecutor(len(config.robots)) as threads:
        robots = list(threads.map(lambda source: _sampled_codes(source, config), team.sources))
    return Bricks(sum(map(_estimated, robots)), _estimated(np.concatenate(robots))).memory(config)


def _sampled_codes(source: ReadAhead, config: ResolvedRun) -> Int64Array:
    """Sampled bricks of each scan of one robot, all scans one after the other."""
    caster = ScanCaster(config.effective_sensor, config.map, config.classes.num_classes)
    found = [np.empty(0, np.int64)]
    for frame in source.frames():
        codes = caster.cast(frame).codes
        found.append(codes[is_sampled(codes)])
    return np.concatenate(found)


def _estimated(codes: Int64Array) -> float:
    """Number of all bricks, estimated from the sampled ones of each scan."""
    found, counts = np.unique(codes, return_counts=True)
    once, twice = np.count_nonzero(counts == 1), np.count_nonzero(counts == 2)
    return SAMPLE * (found.size + once * (once - 1) / (2 * (twice + 1)))


def tile_memory(config: ResolvedRun, scans: Sequence[ScanIndex], num_cells: int) -> int:
    """Return the memory of the process that replays the largest tile with an edge of ``num_cells`` [byte]."""
    own, num_axes = np.concatenate([index.sample for index in scans]), scans[0].blocks.shape[1]
    num_own, num_union = (_counts(brick_keys(codes)[:, :num_axes] // num_cells) for codes in (own, np.unique(own)))
    found = (Bricks(SAMPLE * own, SAMPLE * num_union[tile]).memory(config) for tile, own in num_own.items())
    return round(MARGIN * max(found, default=PROCESS_BYTES))


def join_memory(scans: Sequence[ScanIndex]) -> int:
    """Return the memory of the process that joins one robot's map and evidence of all tiles [byte]."""
    num_union = SAMPLE * np.unique(np.concatenate([index.sample for index in scans])).size
    return PROCESS_BYTES + JOIN_BYTES * num_union


def check_joining(scans: Sequence[ScanIndex], room: float) -> None:
    """Raise ConfigError where a map that is joined takes more than ``room`` [byte]."""
    memory = join_memory(scans)
    if memory > room:
        raise ConfigError(
            f"memory_limit: joining one robot's map takes about {memory / 1e9:.2g} GB, more than {room / 1e9:.2g} GB;"
            " give --tiles with --result-per-tile, which joins no map, a larger limit, or fewer --jobs"
        )


def _counts(places: Int64Array) -> dict[tuple[int, ...], int]:
    """Number of bricks in each tile, given the place of the tile of each brick (n, 2 or 3)."""
    tiles, counts = np.unique(places, axis=0, return_counts=True)
    return {tuple(tile): number for tile, number in zip(tiles.tolist(), counts.tolist(), strict=True)}


def available_memory() -> int:
    """Return the memory that a run without a limit may take [byte]. Raises ConfigError where it is unknown."""
    free = free_bytes()
    if free is None:
        raise ConfigError("tiles: the free memory of this system is unknown; give --memory-limit with --tiles auto")
    return round(FREE_SHARE * free)


def worker_memory(limit: int, num_jobs: int) -> int:
    """Return the memory of each of ``num_jobs`` workers [byte], of which this process leaves a part of ``limit``."""
    return max(limit - PROCESS_BYTES, 0) // num_jobs


def chosen_cells(config: ResolvedRun, scans: Sequence[ScanIndex], room: float) -> int:
    """Return the edge of the largest tiles [cell] of which each one fits into ``room`` [byte], and log it.

    Raises ConfigError where no tiles fit.
    """
    codes, resolution = np.concatenate([index.sample for index in scans]), config.map.resolution
    reach = np.abs(brick_keys(codes)).max(initial=0)
    # Larger tiles would be the same four around the origin.
    num_cells = max(BLOCK_CELLS, 1 << int(reach).bit_length())
    while (memory := tile_memory(config, scans, num_cells)) > room:
        num_cells //= 2
        if num_cells < BLOCK_CELLS:
            raise ConfigError(
                f"memory_limit: a tile of {BLOCK_CELLS * resolution:g} m, the smallest one, takes about"
                f" {memory / 1e9:.2g} GB, more than {room / 1e9:.2g} GB; give a larger limit, fewer --jobs, or a larger"
                " resolution"
            )
    _log.info("tiles: %g m wide; the largest one takes about %.2g GB", num_cells * resolution, memory / 1e9)
    return num_cells
