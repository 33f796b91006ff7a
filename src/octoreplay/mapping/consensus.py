"""One iteration of a consensus rule at one or several robots (Alg. 1 of Asgharivaskasi and Atanasov, and variants)."""

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
from octoreplay.mapping.kernels.consensus import EVIDENCE, FIRST_NEIGHBOUR, LAST_EVIDENCE, OWN
from octoreplay.mapping.kernels.storage import BrickTable
from octoreplay.mapping.octree import Run, SemanticOctree, brick_table, cache_aligned, parts_of
from octoreplay.records import BoolArray, Float32Array, Int64Array, UInt64Array

MOST_BRICKS = 1 << 14
"""Largest number of bricks that are located at once: the table takes about 30 bytes for each octree and brick."""


class Update(IntEnum):
    """Update of a map from the mixed map h~ and the evidence log q; ``team_step`` gives the equations."""

    GRADIENT = consensus_kernels.GRADIENT
    NATURAL = consensus_kernels.NATURAL
    MIX = consensus_kernels.MIX
    ADD = consensus_kernels.ADD
    MERGE = consensus_kernels.MERGE
    COPY = consensus_kernels.COPY
    WEIGHTED = consensus_kernels.WEIGHTED


@dataclass(frozen=True, eq=False)
class Evidence:
    """Evidence of a robot's own scans: log q_i = ``octree`` x ``scale``, divided by ``scan_counts`` cell by cell."""

    octree: SemanticOctree
    scale: float = 1.0
    scan_counts: SemanticOctree | None = None


def gamma_at(consensus: ConsensusConfig, iteration: int) -> float:
    """Return gamma_k = gamma / (1 + k / gamma_decay)^gamma_power of a robot's ``iteration`` k, counted from 0."""
    return float(consensus.gamma / (1.0 + iteration / consensus.gamma_decay) ** consensus.gamma_power)


@dataclass(frozen=True)
class Flows:
    """Coarse amounts that move over a robot's links, equal at both ends (docs/algorithm.md).

    - ``bits``: the step of a cell is its largest |log-odds|, rounded down to a power of two, times 2^-bits; links of
      small weight have more bits (``link_bits``).
    - ``has_flow``: True for each neighbour whose link has flows; the others' amounts are exact.
    - ``gate``: a brick has no flow over a link where in each of its cells both ends have the same label and no class
      differs by ``gate`` times the cell's largest |log-odds| or more; 0 holds nothing back.
    """

    bits: int
    has_flow: Sequence[bool]
    gate: float = 0.0


LARGE_WEIGHT = 0.125
"""Step weight from which a link has no additional bits."""


def link_bits(step_weight: float) -> int:
    """Return the additional bits of a link's flows: max(0, -3 - floor(log2 w)) for the step weight w = 2 epsilon A_ij.

    A flow is at most 2 w m, m the largest |log-odds| in the cell. Without them a robot with many neighbours would round
    most flows to 0.
    """
    # frexp gives floor(log2 x) + 1 exactly.
    return max(0, math.frexp(LARGE_WEIGHT)[1] - math.frexp(np.float32(step_weight))[1])


@dataclass(frozen=True, eq=False)
class Step:
    """Inputs of one robot's iteration.

    - ``own``: the robot's map h_i, changed in place.
    - ``neighbours``: published maps h_j that arrived.
    - ``step_weights``: their w_ij = 2 epsilon A_ij.
    - ``flows``: Flows of the links; None for exact amounts.
    - ``log_likelihood``: log q_i.
    - ``gamma``: gradient step size.
    - ``base``: the robot's own published map b_i (default: ``own``).
    - ``last_evidence``: bricks of log q_i that changed since the last iteration, as they were then; new bricks are in
      it without known cells (default: none changed).
    - ``since``: revision of an earlier step with the same update, gamma, weights and neighbours. Bricks of which all
      revisions are below ``since`` are skipped: the earlier step did not change them, so this one would not either.
      The revisions of all maps must then be correct, including those of decoded maps.
    """

    own: SemanticOctree
    neighbours: Sequence[SemanticOctree]
    step_weights: Sequence[float]
    log_likelihood: SemanticOctree
    gamma: float
    base: SemanticOctree | None = None
    last_evidence: SemanticOctree | None = None
    since: int | None = None
    flows: Flows | None = None


def team_step(
    steps: Sequence[Step],
    *,
    update: Update,
    revision: int,
    clamp: tuple[float, float] = (-math.inf, math.inf),
    quantum: float = 0.0,
    threads: Executor | None = None,
) -> list[float]:
    """Run one iteration at each of several robots, in place; return each robot's largest change of a log-odds.

    The mixed map is h~ = h_i + sum_j f_ij, summed over the neighbours, with f_ij = w_ij (h_j - b_i), or with flows
    f_ij = e trunc(w_ij (h_j - b_i) / e), evaluated in float32. The step e of a cell is
    2^(floor(log2 max_c(|h_j[c]|, |b_i[c]|)) - bits - link_bits(w_ij)), and at least ``quantum``. The gate of the flows
    makes all f_ij of a brick 0. The new map is

    - ``GRADIENT`` (Alg. 1): h_i = h~ + gamma g, g_c = sigma_c (sum_m sigma_m D_m - D_c), with D = h~ - log q_i and
      sigma = softmax(h~);
    - ``NATURAL``: h_i = h~ + gamma (log q_i - h~);
    - ``MIX``: h_i = h~;
    - ``ADD``: h_i = h~ + log q_i - log q_i at the last iteration;
    - ``MERGE``: as ``ADD``, then clamped to ``clamp``; with an empty ``base`` it adds w_ij h_j at every arrival;
    - ``COPY``: h_i = log q_i;
    - ``WEIGHTED``: h_i = h~ with f_ij = w_ij c_j / (c_i + c_j) (h_j - b_i), where the certainty c of a cell is its
      largest |log-odds| over the classes in h_j and b_i, after the consensus of RAMEN (Zhao, Ivanovic and Mehr,
      arXiv:2502.19592). It takes no flows.

    ``GRADIENT``, ``NATURAL`` and ``WEIGHTED`` round the new values to multiples of ``quantum``; 0 does not round.

    h_i[0] stays 0. Changed bricks get ``revision``. The result equals that of the same steps done cell by cell and
    robot by robot, and does not depend on ``threads``. No robot's ``own`` may be among another robot's neighbours.
    """
    if not steps:
        return []
    run: Run = map if threads is None else threads.map
    since = min((step.since for step in steps if step.since is not None), default=0)
    octrees = list({id(octree): octree for step in steps for octree in _octrees(step)}.values())
    codes = union_codes(octrees, None if any(step.since is None for step in steps) else since)
    largest = np.zeros(len(steps), np.float32)
    for start in range(0, codes.size, MOST_BRICKS):
        team = _TeamBricks(steps, octrees, codes[start : start + MOST_BRICKS], since, run)
        team.update(update, clamp, quantum, threads)
        np.maximum(largest, team.finish(revision), out=largest)
    return [float(change) for change in largest]


class _TeamBricks:
    """Bricks ``codes`` (n,) of all octrees of a team's steps; the robots' own ones get the layout of the new values."""

    def __init__(
        self, steps: Sequence[Step], octrees: Sequence[SemanticOctree], codes: Int64Array, since: int, run: Run
    ) -> None:
        self._steps = steps
        self._run = run
        column_of = {id(octree): column for column, octree in enumerate(octrees)}
        self._columns = [np.array([column_of[id(octree)] for octree in _octrees(step)], np.int64) for step in steps]
        self._table = brick_table(octrees, codes, since, run)
        for step, columns in zip(steps, self._columns, strict=True):
            if step.last_evidence is not None:
                _copy_absent(self._table, step.last_evidence.find(codes), columns[LAST_EVIDENCE], columns[EVIDENCE])
        shape, num_words = (len(steps), codes.size), self._table.masks.shape[2]
        self._needs_update, self._known_changed, self._is_even = np.zeros((3, *shape), np.bool_)
        self._changes, self._indices = np.zeros(shape, np.float32), np.empty(shape, np.int64)
        self._layouts, self._known = np.empty((*shape, num_words), np.uint64), np.empty(shape, np.uint64)

        def expand(n: int) -> None:
            own, columns = steps[n].own, self._columns[n]
            self._needs_update[n] = steps[n].since is None
            expanded = expand_to_columns(own, codes, self._table, columns, self._needs_update[n])
            self._indices[n], self._layouts[n], self._known[n], self._known_changed[n] = expanded
            storage.fill_table(own.bricks, self._indices[n], since, self._table, columns[OWN])

        list(run(expand, range(len(steps))))

    def update(self, update: Update, clamp: tuple[float, float], quantum: float, threads: Executor | None) -> None:
        """Write the new values of the bricks that need it."""
        columns = np.concatenate(self._columns)
        first_columns = np.cumsum([0, *(of_robot.size for of_robot in self._columns)])
        weights, flow_weights, shares, has_plain = _link_weights(self._steps)
        gates = np.array([0.0 if step.flows is None else step.flows.gate for step in self._steps], np.float32)
        gammas = np.array([step.gamma for step in self._steps], np.float32)
        num_classes = self._steps[0].own.num_classes

        def work(part: Int64Array) -> None:
            consensus_kernels.team_step(
                part[0], part[-1] + 1, self._table, columns, first_columns, weights, flow_weights, shares, gates,
                has_plain, np.float32(quantum), gammas, int(update), num_classes, np.float32(clamp[0]),
                np.float32(clamp[1]), self._layouts.reshape(-1, self._layouts.shape[2]), self._known.ravel(),
                self._needs_update, *_scratch(num_classes, np.diff(first_columns).max()), self._changes, self._is_even,
            )  # fmt: skip

        list(self._run(work, parts_of(self._known.shape[1], threads)))

    def finish(self, revision: int) -> list[float]:
        """Set the revisions of changed bricks and prune them; return each robot's largest change."""

        def finish(n: int) -> float:
            own, column = self._steps[n].own, self._columns[n][OWN]
            largest = consensus_kernels.finish_step(
                own.bricks, self._indices[n], self._table, column, self._changes[n], self._is_even[n],
                self._known_changed[n], revision,
            )  # fmt: skip
            return float(largest)

        return list(self._run(finish, range(len(self._steps))))


def _copy_absent(table: BrickTable, indices: Int64Array, column: int, source: int) -> None:
    """Copy the entries of the absent bricks of a column, where ``indices`` (n,) are -1, from the column ``source``."""
    is_absent = indices < 0
    for array in table:
        array[column, is_absent] = array[source, is_absent]


def _link_weights(steps: Sequence[Step]) -> tuple[Float32Array, Float32Array, Float32Array, BoolArray]:
    """Weights of the links without and with flows and shares of the flows' steps, at the kernel's columns.

    The last array tells which robots have plain links.
    """
    plain, flowing, shares, has_plain = [], [], [], []
    for step in steps:
        has_flow = step.flows.has_flow if step.flows is not None else [False] * len(step.neighbours)
        bits = 0 if step.flows is None else step.flows.bits
        own = [0.0] * FIRST_NEIGHBOUR
        plain += [*own, *(0.0 if flow else w for w, flow in zip(step.step_weights, has_flow, strict=True))]
        flowing += [*own, *(w if flow else 0.0 for w, flow in zip(step.step_weights, has_flow, strict=True))]
        shares += [*own, *(2.0 ** -(bits + link_bits(w)) for w in step.step_weights)]
        has_plain.append(not all(has_flow))
    return (
        np.array(plain, np.float32), np.array(flowing, np.float32), np.array(shares, np.float32), np.array(has_plain),
    )  # fmt: skip


def _octrees(step: Step) -> list[SemanticOctree]:
    """Return the octrees of a step in the order of the kernel's columns."""
    base = step.own if step.base is None else step.base
    last = step.log_likelihood if step.last_evidence is None else step.last_evidence
    return [step.own, base, step.log_likelihood, last, *step.neighbours]


def union_codes(octrees: Sequence[SemanticOctree], since: int | None) -> Int64Array:
    """Return the sorted codes (n,) of all octrees' bricks; with ``since``, of bricks with at least this revision."""
    union = SemanticOctree(1.0, 1)
    for octree in octrees:
        union.find_or_add(octree.codes if since is None else octree.codes[octree.revisions >= since])
    return np.sort(union.codes)


def expand_to_columns(
    octree: SemanticOctree, codes: Int64Array, table: BrickTable, columns: Int64Array, needs_update: BoolArray
) -> tuple[Int64Array, UInt64Array, UInt64Array, BoolArray]:
    """Expand an octree's bricks ``codes`` (n,) by the known cells and class rows of some columns of a table.

    ``needs_update`` (n,) is changed in place: True is added where a brick changed, and removed where no cell is known.
    The other bricks are skipped. Returns the brick indices (n,), -1 for skipped bricks, the class rows (n, W), the
    known cells (n,), and where known cells were added (n,).
    """
    known, has_block = np.zeros(codes.size, np.uint64), np.zeros(codes.size, np.bool_)
    masks = np.zeros((codes.size, table.masks.shape[2]), np.uint64)
    consensus_kernels.join_columns(table, columns, needs_update, known, has_block, masks)
    indices = np.full(codes.size, -1)
    indices[needs_update] = octree.find_or_add(codes[needs_update])
    known_changed = octree.expand_bricks(indices, masks, known, has_block)
    updated = indices[needs_update]
    masks[needs_update], known[needs_update] = octree.bricks.masks[updated], octree.known[updated]
    return indices, masks, known, known_changed


def _scratch(num_classes: int, num_columns: int) -> tuple[Float32Array, Int64Array]:
    """Return scratch memory of the kernels: blocks with all rows, and integers for rows and columns."""
    blocks = (consensus_kernels.NUM_SCRATCH_BLOCKS + num_columns) * (num_classes + 1) + 3
    return (
        cache_aligned((blocks, storage.BRICK_CELLS), np.float32),
        np.empty((2, max(storage.OCTETS * (num_classes + 1), num_columns)), np.int64),
    )


def scaled_map(octree: SemanticOctree, factor: float) -> SemanticOctree:
    """Return an octree with the deviations of another one, multiplied by ``factor``."""
    scaled = SemanticOctree(octree.resolution, octree.num_classes)
    sum_of_evidence(scaled, [Evidence(octree, scale=factor)], octree.codes, 0)
    return scaled


def sum_of_evidence(target: SemanticOctree, evidence: Sequence[Evidence], codes: Int64Array, revision: int) -> None:
    """Write sum_i log q_i of the bricks ``codes`` (n,) into ``target``: the oracle, or one robot's log q_i.

    Either all entries of ``evidence`` have scan counts, or none has. Written bricks get ``revision``.
    """
    if not codes.size:
        return
    octrees = [entry.octree for entry in evidence]
    counts = [entry.scan_counts for entry in evidence if entry.scan_counts is not None]
    table, count_table = brick_table(octrees, codes), brick_table(counts, codes)
    columns = np.arange(len(octrees))
    indices, masks, known, _ = expand_to_columns(target, codes, table, columns, np.ones(codes.size, np.bool_))
    target.expand_bricks(indices, masks, known, (count_table.addresses != 0).any(axis=0))
    scales: Float32Array = np.array([entry.scale for entry in evidence], np.float32)
    scratch, int_scratch = _scratch(target.num_classes, 0)
    consensus_kernels.sum_evidence(
        target.bricks, indices, table, masks, known, count_table, scales, target.num_classes, scratch, int_scratch[0],
        np.zeros((codes.size, 1), np.uint64),
    )  # fmt: skip
    target.bricks.revisions[indices[indices >= 0]] = revision
