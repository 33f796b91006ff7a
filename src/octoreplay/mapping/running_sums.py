"""The arithmetic of rule ``ratio``: ratio consensus with running sums, exact over any length of run.

Source: Hadjicostis, Vaidya and Dominguez-Garcia, 'Robust Distributed Average Consensus via Exchange of Running Sums',
IEEE Transactions on Automatic Control 61(6), 2016. Robot i keeps a *mass* y_i for each cell and class, which starts as
its evidence, and one *weight* z_i, which starts as WHOLE_WEIGHT. In each tick with D receivers it keeps one of D + 1
equal shares of both, and adds one to what it sends: the running sums sigma_i and eta_i of all the shares so far. A
receiver takes in what they grew by since it last heard of them, so the next packet brings what a lost one withheld.
Nothing is ever created or lost, so all y_i / z_i tend to the mean of the evidence.

A link that comes up later carries what came since, and one that was down goes on where it stopped: what was summed up
meanwhile is not for its receiver. The sender takes it off (``difference``).

Masses and running sums are octrees, integers in units of UNIT modulo MODULUS, stored as the bits of the float32 values
(kernels/running_sums.py). Sums may wrap around for ever: only differences count, and these are exact modulo MODULUS
however large they are. A mass is read as the number nearest to 0, so |y_i| must stay below MAX_MASS. All weights and
what is under way of them add up to the number of robots N, so |y_i| <= clamp N while evidence within +-clamp rests.
Evidence that changes may add to that; with 4 clamp N below the limit there is room for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from typing import NamedTuple

import numpy as np

from octoreplay.mapping.consensus import NUM_PARTS, raise_to_columns, union_codes
from octoreplay.mapping.kernels import consensus as consensus_kernels
from octoreplay.mapping.kernels import running_sums as kernels
from octoreplay.mapping.kernels import storage
from octoreplay.mapping.kernels.running_sums import MODULUS, SOURCE, TARGET
from octoreplay.mapping.kernels.storage import BrickTable
from octoreplay.mapping.octree import Run, SemanticOctree, brick_table, cache_aligned
from octoreplay.records import BoolArray, Float32Array, Int64Array, UInt64Array

Arrival = tuple[SemanticOctree, SemanticOctree | None]
"""A sender's running sum as it is now, and as the receiver last had it."""
UNIT = 1.0 / float(kernels.UNITS_PER_LOG_ODDS)
"""Log-odds of one unit of a mass."""
MAX_MASS = MODULUS // 2 - 1
"""Units of the largest mass that is told from a negative one: 4096 log-odds."""
WEIGHT_UNIT = 2.0**-40
"""One unit of a weight."""
WHOLE_WEIGHT = 1 << 40
"""Units of the weight with which every robot starts."""
LEAST_WEIGHT = WHOLE_WEIGHT // 4
"""Units below which a weight says that the robot gave much and heard little: y_i / z_i shows its rounding, about D / 2
units, and its new evidence 1 / z_i times too large. It should give nothing more until it hears more, and leave its map
to its own evidence meanwhile."""


def share_weight(weight: int, num_receivers: int) -> tuple[int, int]:
    """What each receiver gets of a weight, and what the robot keeps, which is more than 0 [WEIGHT_UNIT]."""
    share = weight // (1 + num_receivers) if num_receivers else 0
    return share, weight - num_receivers * share


def share_out(mass: SemanticOctree, total: SemanticOctree, num_receivers: int, revision: int) -> None:
    """Move the shares of so many receivers from a mass, and add one of them to its running sum ``total``, in place.

    A share is mass / (1 + ``num_receivers``), rounded to nearest, ties to even; the robot keeps what the rounded shares
    leave. Bricks that change get ``revision``. Without receivers nothing changes.
    """
    if num_receivers == 0:
        return
    rows = _rows(total, mass, mass.codes)
    shares = np.empty(mass.num_bricks, np.int32)
    kernels.share_out(
        rows.table, rows.layout, rows.known, num_receivers, total.num_classes, _scratch(total.num_classes), shares
    )
    is_changed = np.maximum(shares, rows.known_changed).astype(np.float32)
    _store(total, rows.indices, rows.table, TARGET, is_changed, revision)
    _store(mass, np.arange(mass.num_bricks), rows.table, SOURCE, is_changed, revision)


def take_in(mass: SemanticOctree, arrivals: Sequence[Arrival], revision: int) -> None:
    """Add to a mass, in place, what the running sums of some senders grew by: (new, old), old None for 0 everywhere.

    The new ones have all cells of the old ones; these become known. Bricks that change get ``revision``.
    """
    team_take_in([(mass, arrivals)], revision)


def team_take_in(
    robots: Sequence[tuple[SemanticOctree, Sequence[Arrival]]], revision: int, threads: Executor | None = None
) -> None:
    """What ``take_in`` does for each of several robots' masses; sums that several of them heard are looked up once.

    The result does not depend on ``threads``.
    """
    if not robots:
        return
    first = robots[0][0]
    nothing = SemanticOctree(first.resolution, first.num_classes)
    differences = [
        (mass, [nothing if octree is None else octree for arrival in arrivals for octree in arrival])
        for mass, arrivals in robots
    ]
    news = {id(octree): octree for _, columns in differences for octree in columns[::2]}
    _add_differences(differences, union_codes(list(news.values()), None), revision, threads=threads)


def add_evidence(
    mass: SemanticOctree, evidence: SemanticOctree, last_evidence: SemanticOctree, since: int, revision: int
) -> None:
    """Add to a mass, in place, what a robot's evidence [log-odds] changed by since it was ``last_evidence``.

    Both are rounded to units first, so that the steps add up to the evidence itself. Only the bricks with a revision of
    the evidence from ``since`` on are looked at. Bricks that change get ``revision``.
    """
    codes = evidence.codes[evidence.revisions >= since]
    _add_differences([(mass, [evidence, last_evidence])], codes, revision, of_evidence=True)


def difference(new: SemanticOctree, old: SemanticOctree) -> SemanticOctree:
    """The octree of what running sums grew by, new - old modulo MODULUS, in the cells of the new ones."""
    result = SemanticOctree(new.resolution, new.num_classes)
    take_in(result, [(new, old)], 0)
    return result


def recovered(mass: SemanticOctree, weight: int, into: SemanticOctree, revision: int, tolerance: float = 0.0) -> float:
    """Write the map y_i / z_i [log-odds] of a mass and a weight > 0 [WEIGHT_UNIT] ``into`` an octree.

    Values that would change by at most ``tolerance`` stay: rounding moves masses by some units in every tick for ever.
    Bricks that change get ``revision``, those of one value are pruned; bricks that the mass does not have stay as they
    are. Returns the largest change of a log-odds.
    """
    rows = _rows(into, mass, mass.codes)
    changes, is_even = np.empty(rows.known.size, np.float32), np.zeros(rows.known.size, np.bool_)
    kernels.recover(
        rows.table, rows.layout, rows.known, UNIT / (weight * WEIGHT_UNIT), np.float32(tolerance), into.num_classes,
        _scratch(into.num_classes), changes, is_even,
    )  # fmt: skip
    return float(
        consensus_kernels.finish_step(
            into.bricks, rows.indices, rows.table, TARGET, changes, is_even, rows.known_changed, revision
        )
    )


class _Rows(NamedTuple):
    """Bricks (n,) of an octree that holds the cells and rows of others, and where theirs lie, its own among them.

    ``indices`` (n,) are those in the octree, -1 for none, ``layout`` (n, W) and ``known`` (n,) its masks and known
    cells, and ``known_changed`` (n,) says where it got new ones.
    """

    table: BrickTable
    indices: Int64Array
    layout: UInt64Array
    known: UInt64Array
    known_changed: BoolArray


def _rows(target: SemanticOctree, source: SemanticOctree, codes: Int64Array) -> _Rows:
    """The bricks ``codes`` (n,) of a target that takes on those of a source."""
    return _raised(target, codes, brick_table([target, source], codes), np.array([TARGET, SOURCE]))


def _raised(target: SemanticOctree, codes: Int64Array, table: BrickTable, columns: Int64Array) -> _Rows:
    """Give a target, the first of the table's ``columns``, the cells, blocks and rows that hold those of all."""
    raised = raise_to_columns(target, codes, table, columns, np.ones(codes.size, np.bool_))
    storage.fill_table(target.bricks, raised[0], 0, table, columns[0])
    return _Rows(table, *raised)


def _scratch(num_classes: int) -> Float32Array:
    """What the kernels work in: blocks with a row for every class in every octet."""
    return cache_aligned((kernels.NUM_SCRATCH_BLOCKS * (num_classes + 1), storage.BRICK_CELLS), np.float32)


def _add_differences(
    robots: Sequence[tuple[SemanticOctree, Sequence[SemanticOctree]]], codes: Int64Array, revision: int, *,
    of_evidence: bool = False, threads: Executor | None = None,
) -> None:  # fmt: skip
    """Add octrees 0 - 1, 2 - 3, ... in the bricks ``codes`` (n,) to each of the masses that they come with."""
    run: Run = map if threads is None else threads.map
    octrees = list({id(octree): octree for mass, others in robots for octree in (mass, *others)}.values())
    column_of = {id(octree): column for column, octree in enumerate(octrees)}
    table = brick_table(octrees, codes, run=run)
    columns = [np.array([column_of[id(octree)] for octree in (mass, *others)], np.int64) for mass, others in robots]
    rows = list(run(lambda n: _raised(robots[n][0], codes, table, columns[n]), range(len(robots))))
    layouts, known = np.concatenate([of_robot.layout for of_robot in rows]), np.concatenate([r.known for r in rows])
    all_columns, first_columns = np.concatenate(columns), np.cumsum([0, *(of_robot.size for of_robot in columns)])
    is_changed = np.empty((len(robots), codes.size), np.float32)
    num_classes = robots[0][0].num_classes

    def work(part: Int64Array) -> None:
        kernels.add_differences(
            part[0], part[-1] + 1, table, all_columns, first_columns, of_evidence, layouts, known, num_classes,
            _scratch(num_classes), is_changed,
        )  # fmt: skip

    parts = np.array_split(np.arange(codes.size), 1 if threads is None else NUM_PARTS)
    list(run(work, [part for part in parts if part.size]))

    def finish(n: int) -> None:
        changes = np.maximum(is_changed[n], rows[n].known_changed)
        _store(robots[n][0], rows[n].indices, table, columns[n][0], changes, revision)

    list(run(finish, range(len(robots))))


def _store(
    octree: SemanticOctree, indices: Int64Array, table: BrickTable, column: int, is_changed: Float32Array, revision: int
) -> None:
    """Store what is one value in a column of the table, and mark the bricks ``indices`` (n,) that changed.

    Nothing is pruned: histories differ from cell to cell, so what is even in one tick is not in the next.
    """
    never = np.zeros(indices.size, np.bool_)
    consensus_kernels.finish_step(octree.bricks, indices, table, column, is_changed, never, never, revision)
