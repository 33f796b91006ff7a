"""One iteration of a consensus rule at one robot (Alg. 1 of Asgharivaskasi and Atanasov, and its relatives)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from octoreplay.config.consensus import ConsensusConfig
from octoreplay.mapping.kernels import consensus as consensus_kernels
from octoreplay.mapping.kernels import storage
from octoreplay.mapping.kernels.consensus import FIRST_NEIGHBOUR, OWN
from octoreplay.mapping.kernels.storage import BrickTable
from octoreplay.mapping.octree import Run, SemanticOctree, brick_table, cache_aligned
from octoreplay.records import BoolArray, Float32Array, Int64Array, UInt64Array


class Update(IntEnum):
    """Update of a map from the mixed map h~ and the evidence log q; ``team_step`` gives the equations."""

    GRADIENT = consensus_kernels.GRADIENT
    NATURAL = consensus_kernels.NATURAL
    BAYES = consensus_kernels.BAYES
    MERGE = consensus_kernels.MERGE
    COPY = consensus_kernels.LOCAL


@dataclass(frozen=True, eq=False)
class Evidence:
    """What a robot's own scans say: log q_i = ``octree`` x ``scale``, or divided by each cell's ``scan_counts``."""

    octree: SemanticOctree
    scale: float = 1.0
    scan_counts: SemanticOctree | None = None


def gamma_at(consensus: ConsensusConfig, iteration: int) -> float:
    """gamma_k = gamma / (1 + k / gamma_decay)^gamma_power of a robot's own iteration k, counted from 0."""
    return float(consensus.gamma / (1.0 + iteration / consensus.gamma_decay) ** consensus.gamma_power)


@dataclass(frozen=True, eq=False)
class Step:
    """One robot's iteration: its map, which is changed in place, and what it is changed by.

    ``neighbours`` are the published maps h_j that arrived, ``step_weights`` their w_ij = 2 epsilon A_ij; ``base`` b_i
    is the robot's own published map (default: ``own`` itself), ``log_likelihood`` log q_i, and ``last_log_likelihood``
    the same at the last iteration.

    With ``since``, the revision of an earlier step with the same update, gamma, weights and neighbours, the bricks at
    rest are skipped: those that no map has given a revision from ``since`` on. That step changed nothing in them, so
    this one would not either. All maps' revisions must then be right, the decoded ones' included.
    """

    own: SemanticOctree
    neighbours: Sequence[SemanticOctree]
    step_weights: Sequence[float]
    log_likelihood: SemanticOctree
    gamma: float
    base: SemanticOctree | None = None
    last_log_likelihood: SemanticOctree | None = None
    since: int | None = None


NUM_PARTS = 16
"""Parts that a step in threads is cut into."""


def team_step(
    steps: Sequence[Step],
    *,
    update: Update,
    revision: int,
    clamp: tuple[float, float] = (-math.inf, math.inf),
    threads: Executor | None = None,
) -> list[float]:
    """One iteration at each of several robots, in place; returns each one's largest change of a log-odds.

    h~ = h_i + sum_j w_ij (h_j - b_i) over the neighbours. Then

    - ``GRADIENT`` (Alg. 1): h_i = h~ + gamma g, g_c = sigma_c (sum_m sigma_m D_m - D_c), with D = h~ - log q_i and
      sigma = softmax(h~);
    - ``NATURAL``: h_i = h~ + gamma (log q_i - h~);
    - ``BAYES``: h_i = h~ + log q_i - log q_i at the last iteration;
    - ``MERGE``: as ``BAYES``, then clamped; with an empty ``base`` it adds w_ij h_j, again at every arrival;
    - ``COPY``: h_i = log q_i.

    h_i[0] stays 0. Bricks that changed get ``revision``. The result is that of the same steps done cell by cell, robot
    by robot, and does not depend on ``threads``; no robot's ``own`` may be a neighbour's map of another.
    """
    if not steps:
        return []
    run: Run = map if threads is None else threads.map
    octrees = list({id(octree): octree for step in steps for octree in _octrees(step)}.values())
    column_of = {id(octree): column for column, octree in enumerate(octrees)}
    all_since = [step.since for step in steps if step.since is not None]
    since = min(all_since, default=0)
    codes = union_codes(octrees, since if len(all_since) == len(steps) else None)
    table = brick_table(octrees, codes, since, run)
    columns = [np.array([column_of[id(octree)] for octree in _octrees(step)], np.int64) for step in steps]
    shape = (len(steps), codes.size)
    is_awake, known_changed, is_even = np.zeros((3, *shape), np.bool_)
    changes = np.zeros(shape, np.float32)
    indices = np.empty(shape, np.int64)
    layouts, known = np.empty((*shape, table.masks.shape[2]), np.uint64), np.empty(shape, np.uint64)

    def prepare(n: int) -> None:
        own = steps[n].own
        is_awake[n] = steps[n].since is None
        raised = raise_to_columns(own, codes, table, columns[n], is_awake[n])
        indices[n], layouts[n], known[n], known_changed[n] = raised
        storage.fill_table(own.bricks, indices[n], since, table, columns[n][OWN])

    list(run(prepare, range(len(steps))))
    all_columns = np.concatenate(columns)
    first_columns = np.cumsum([0, *(of_robot.size for of_robot in columns)])
    weights = np.concatenate([[0.0] * FIRST_NEIGHBOUR + list(step.step_weights) for step in steps]).astype(np.float32)
    gammas = np.array([step.gamma for step in steps], np.float32)
    num_classes = steps[0].own.num_classes

    def work(part: Int64Array) -> None:
        consensus_kernels.team_step(
            part[0], part[-1] + 1, table, all_columns, first_columns, weights, gammas, int(update), num_classes,
            np.float32(clamp[0]), np.float32(clamp[1]), layouts.reshape(-1, layouts.shape[2]), known.ravel(), is_awake,
            *_scratch(num_classes, np.diff(first_columns).max()), changes, is_even,
        )  # fmt: skip

    parts = np.array_split(np.arange(codes.size), 1 if threads is None else NUM_PARTS)
    list(run(work, [part for part in parts if part.size]))

    def finish(n: int) -> float:
        return float(
            consensus_kernels.finish_step(
                steps[n].own.bricks, indices[n], table, columns[n][OWN], changes[n], is_even[n], known_changed[n],
                revision,
            )
        )  # fmt: skip

    return list(run(finish, range(len(steps))))


def _octrees(step: Step) -> list[SemanticOctree]:
    """The octrees of a step in the order of the kernel's columns."""
    base = step.own if step.base is None else step.base
    last = step.log_likelihood if step.last_log_likelihood is None else step.last_log_likelihood
    return [step.own, base, step.log_likelihood, last, *step.neighbours]


def union_codes(octrees: Sequence[SemanticOctree], since: int | None) -> Int64Array:
    """Sorted codes (n,) of the bricks of any of the octrees; with ``since`` of those that changed from there on."""
    union = SemanticOctree(1.0, 1)
    for octree in octrees:
        union.find_or_add(octree.codes if since is None else octree.codes[octree.revisions >= since])
    return np.sort(union.codes)


def raise_to_columns(
    octree: SemanticOctree, codes: Int64Array, table: BrickTable, columns: Int64Array, is_awake: BoolArray
) -> tuple[Int64Array, UInt64Array, UInt64Array, BoolArray]:
    """Give an octree the cells, blocks and rows that it takes to hold the awake bricks ``codes`` (n,) of the columns.

    Bricks that changed are awake, those without a known cell are not. Returns the indices (n,), -1 for the others, the
    masks (n, W) and known cells (n,), and where known cells were added (n,).
    """
    known, has_block = np.zeros(codes.size, np.uint64), np.zeros(codes.size, np.bool_)
    masks = np.zeros((codes.size, table.masks.shape[2]), np.uint64)
    consensus_kernels.join_columns(table, columns, is_awake, known, has_block, masks)
    indices = np.full(codes.size, -1)
    indices[is_awake] = octree.find_or_add(codes[is_awake])
    known_changed = octree.raise_bricks(indices, masks, known, has_block)
    masks[is_awake], known[is_awake] = octree.bricks.masks[indices[is_awake]], octree.known[indices[is_awake]]
    return indices, masks, known, known_changed


def _scratch(num_classes: int, num_columns: int) -> tuple[Float32Array, Int64Array]:
    """What the kernels work in: blocks with a row for every class in every octet, and numbers for rows and columns."""
    blocks = (consensus_kernels.NUM_SCRATCH_BLOCKS + num_columns) * (num_classes + 1) + 3
    return (
        cache_aligned((blocks, storage.BRICK_CELLS), np.float32),
        np.empty((2, max(storage.OCTETS * (num_classes + 1), num_columns)), np.int64),
    )


def sum_of_evidence(target: SemanticOctree, evidence: Sequence[Evidence], codes: Int64Array, revision: int) -> None:
    """Write sum_i log q_i of the bricks ``codes`` (n,) into ``target``: the oracle, or one robot's log q_i.

    All robots read their evidence the same way. Bricks that are written get ``revision``.
    """
    octrees = [entry.octree for entry in evidence]
    counts = [entry.scan_counts for entry in evidence if entry.scan_counts is not None]
    table, count_table = brick_table(octrees, codes), brick_table(counts, codes)
    columns = np.arange(len(octrees))
    indices, masks, known, _ = raise_to_columns(target, codes, table, columns, np.ones(codes.size, np.bool_))
    target.raise_bricks(indices, masks, known, (count_table.addresses != 0).any(axis=0))
    scales: Float32Array = np.array([entry.scale for entry in evidence], np.float32)
    scratch, int_scratch = _scratch(target.num_classes, 0)
    consensus_kernels.sum_evidence(
        target.bricks, indices, table, masks, known, count_table, scales, target.num_classes, scratch, int_scratch[0],
        np.zeros((codes.size, 1), np.uint64),
    )  # fmt: skip
    target.bricks.revisions[indices[indices >= 0]] = revision
