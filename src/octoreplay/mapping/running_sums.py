"""Ratio consensus with running sums in integer arithmetic, exact over any length of run: rule ``ratio``.

Source: Hadjicostis, Vaidya and Dominguez-Garcia, 'Robust Distributed Average Consensus via Exchange of Running Sums',
IEEE Transactions on Automatic Control 61(6), 2016.

- Robot i keeps a *mass* y_i for each cell and class, which starts as its evidence, and one *weight* z_i, which starts
  as WHOLE_WEIGHT.
- In each tick with D receivers, mass and weight are divided into D + 1 equal shares. The robot keeps one share and adds
  one to the running sums sigma_i (mass) and eta_i (weight) that it sends to all receivers.
- A receiver adds the difference between the running sums that arrive and the last ones it received to its own mass and
  weight. So a later packet replaces a lost one.
- The totals of mass and weight are conserved, and all y_i / z_i converge to the mean of the evidence.

A link that comes up starts from the running sums of that time, and a link that was down continues from the sums at
which it stopped: shares added meanwhile are not for its receiver. The sender subtracts them (``difference``).

Masses and running sums are octrees of integers in units of UNIT modulo MODULUS, stored as the bits of the float32
values (kernels/running_sums.py). Sums may wrap around any number of times: only differences are used, and these are
exact modulo MODULUS. A mass is read as the number nearest to 0, so |y_i| must stay below MAX_MASS. The weights of all
robots and of packets under way add up to the number of robots N, so |y_i| <= clamp N while evidence within +-clamp does
not change. Changing evidence may add to that; 4 clamp N below the limit leaves room for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from typing import NamedTuple

import numpy as np

from octoreplay.mapping.consensus import expand_to_columns, union_codes
from octoreplay.mapping.kernels import consensus as consensus_kernels
from octoreplay.mapping.kernels import running_sums as kernels
from octoreplay.mapping.kernels import storage
from octoreplay.mapping.kernels.running_sums import MODULUS, SOURCE, TARGET
from octoreplay.mapping.kernels.storage import BrickTable
from octoreplay.mapping.octree import Run, SemanticOctree, brick_table, cache_aligned, parts_of
from octoreplay.records import BoolArray, Float32Array, Int64Array, UInt64Array

Arrival = tuple[SemanticOctree, SemanticOctree | None]
"""A sender's running sum as it arrived, and the last one that the receiver had; None for none."""
UNIT = 1.0 / float(kernels.UNITS_PER_LOG_ODDS)
"""Size of one unit of a mass [log-odds]."""
MAX_MASS = MODULUS // 2 - 1
"""Largest mass that is not read as a negative one, 4096 log-odds [UNIT]."""
WEIGHT_UNIT = 2.0**-40
"""Size of one unit of a weight."""
WHOLE_WEIGHT = 1 << 40
"""Weight with which every robot starts [WEIGHT_UNIT]."""
LEAST_WEIGHT = WHOLE_WEIGHT // 4
"""Smallest usable weight [WEIGHT_UNIT]. A robot that sends much and receives little has a small weight; y_i / z_i then
amplifies new evidence, and rounding of about D / 2 units, by 1 / z_i. Below this weight a robot should send no shares
and update its map from its own evidence alone."""


def share_weight(weight: int, num_receivers: int) -> tuple[int, int]:
    """Return each receiver's share of a weight, and the robot's rest, which is more than 0 [WEIGHT_UNIT]."""
    share = weight // (1 + num_receivers) if num_receivers else 0
    return share, weight - num_receivers * share


def share_out(mass: SemanticOctree, total: SemanticOctree, num_receivers: int, revision: int) -> None:
    """Take the shares of all receivers from a mass and add one of them to its running sum ``total``, both in place.

    A share is mass / (1 + ``num_receivers``), rounded to nearest, ties to even; the robot keeps the rest. Changed
    bricks get ``revision``. Without receivers nothing changes.
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


def receive(mass: SemanticOctree, arrivals: Sequence[Arrival], revision: int) -> None:
    """Add the differences new - old of running sums that arrived to a mass, in place.

    A new sum has all cells of the old one; they become known in the mass. Changed bricks get ``revision``.
    """
    receive_team([(mass, arrivals)], revision)


def receive_team(
    robots: Sequence[tuple[SemanticOctree, Sequence[Arrival]]], revision: int, threads: Executor | None = None
) -> None:
    """Apply ``receive`` to the masses of several robots; running sums that several robots received are looked up once.

    The result does not depend on ``threads``.
    """
    if not robots:
        return
    first = robots[0][0]
    empty = SemanticOctree(first.resolution, first.num_classes)
    differences = [
        (mass, [empty if octree is None else octree for arrival in arrivals for octree in arrival])
        for mass, arrivals in robots
    ]
    news = {id(octree): octree for _, columns in differences for octree in columns[::2]}
    _add_differences(differences, union_codes(list(news.values()), None), revision, threads=threads)


def add_evidence(
    mass: SemanticOctree, evidence: SemanticOctree, last_evidence: SemanticOctree, since: int, revision: int
) -> None:
    """Add the change of a robot's evidence since ``last_evidence`` [log-odds] to a mass, in place.

    Both are rounded to units before they are subtracted, so that the changes add up to the rounded evidence. Only
    bricks with a revision of the evidence >= ``since`` are used; ``last_evidence`` has at least these bricks. Changed
    bricks get ``revision``.
    """
    codes = evidence.codes[evidence.revisions >= since]
    _add_differences([(mass, [evidence, last_evidence])], codes, revision, of_evidence=True)


def difference(new: SemanticOctree, old: SemanticOctree) -> SemanticOctree:
    """Return the octree of the difference new - old of running sums modulo MODULUS, in the cells of the new one."""
    result = SemanticOctree(new.resolution, new.num_classes)
    receive(result, [(new, old)], 0)
    return result


def recover_map(
    mass: SemanticOctree, weight: int, into: SemanticOctree, revision: int, tolerance: float = 0.0
) -> float:
    """Write the map y_i / z_i [log-odds] of a mass and a weight > 0 [WEIGHT_UNIT] ``into`` an octree.

    Values that would change by at most ``tolerance`` do not change, because rounding changes masses by some units in
    every tick. Changed bricks get ``revision`` and are pruned; bricks that the mass does not have do not change.
    Returns the largest change of a log-odds.
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
    """Bricks of an octree that was expanded by the layouts of others.

    - ``table``: locations of the bricks in all octrees, including the expanded one.
    - ``indices`` (n,): brick indices in the expanded octree, -1 for none.
    - ``layout`` (n, W), ``known`` (n,): its class rows and known cells.
    - ``known_changed`` (n,): True where cells became known.
    """

    table: BrickTable
    indices: Int64Array
    layout: UInt64Array
    known: UInt64Array
    known_changed: BoolArray


def _rows(target: SemanticOctree, source: SemanticOctree, codes: Int64Array) -> _Rows:
    """Expand the bricks ``codes`` (n,) of a target by those of a source."""
    return _expanded(target, codes, brick_table([target, source], codes), np.array([TARGET, SOURCE]))


def _expanded(target: SemanticOctree, codes: Int64Array, table: BrickTable, columns: Int64Array) -> _Rows:
    """Expand the bricks of a target, the first of the table's ``columns``, by those of all the columns."""
    expanded = expand_to_columns(target, codes, table, columns, np.ones(codes.size, np.bool_))
    storage.fill_table(target.bricks, expanded[0], 0, table, columns[0])
    return _Rows(table, *expanded)


def _scratch(num_classes: int) -> Float32Array:
    """Return scratch memory of the kernels: blocks with all rows."""
    return cache_aligned((kernels.NUM_SCRATCH_BLOCKS * (num_classes + 1), storage.BRICK_CELLS), np.float32)


def _add_differences(
    robots: Sequence[tuple[SemanticOctree, Sequence[SemanticOctree]]], codes: Int64Array, revision: int, *,
    of_evidence: bool = False, threads: Executor | None = None,
) -> None:  # fmt: skip
    """Add the differences of octrees 0 - 1, 2 - 3, ... to each mass, in the bricks ``codes`` (n,)."""
    run: Run = map if threads is None else threads.map
    octrees = list({id(octree): octree for mass, others in robots for octree in (mass, *others)}.values())
    column_of = {id(octree): column for column, octree in enumerate(octrees)}
    table = brick_table(octrees, codes, run=run)
    columns = [np.array([column_of[id(octree)] for octree in (mass, *others)], np.int64) for mass, others in robots]
    rows = list(run(lambda n: _expanded(robots[n][0], codes, table, columns[n]), range(len(robots))))
    layouts, known = np.concatenate([of_robot.layout for of_robot in rows]), np.concatenate([r.known for r in rows])
    all_columns, first_columns = np.concatenate(columns), np.cumsum([0, *(of_robot.size for of_robot in columns)])
    is_changed = np.empty((len(robots), codes.size), np.float32)
    num_classes = robots[0][0].num_classes

    def work(part: Int64Array) -> None:
        kernels.add_differences(
            part[0], part[-1] + 1, table, all_columns, first_columns, of_evidence, layouts, known, num_classes,
            _scratch(num_classes), is_changed,
        )  # fmt: skip

    list(run(work, parts_of(codes.size, threads)))

    def finish(n: int) -> None:
        changes = np.maximum(is_changed[n], rows[n].known_changed)
        _store(robots[n][0], rows[n].indices, table, columns[n][0], changes, revision)

    list(run(finish, range(len(robots))))


def _store(
    octree: SemanticOctree, indices: Int64Array, table: BrickTable, column: int, is_changed: Float32Array, revision: int
) -> None:
    """Store the bricks of one value from a column of the table, and set the revision of changed ``indices`` (n,).

    Nothing is pruned: masses of equal cells differ again in the next tick, because their histories differ.
    """
    never = np.zeros(indices.size, np.bool_)
    consensus_kernels.finish_step(octree.bricks, indices, table, column, is_changed, never, never, revision)
