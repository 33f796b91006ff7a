"""One iteration of a consensus rule at one robot (Alg. 1 of Asgharivaskasi and Atanasov, and its relatives)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from octoreplay.config import ConsensusConfig
from octoreplay.mapping.kernels import consensus as consensus_kernels
from octoreplay.mapping.kernels import storage
from octoreplay.mapping.kernels.consensus import OWN
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.records import Float32Array, Int64Array, UInt8Array

_RULES = {
    "gradient": consensus_kernels.GRADIENT,
    "natural": consensus_kernels.NATURAL,
    "bayes": consensus_kernels.BAYES,
    "local": consensus_kernels.LOCAL,
}


@dataclass(frozen=True, eq=False)
class Evidence:
    """What a robot's own scans say: log q_i = ``octree`` x ``scale``, or divided by each cell's ``scan_counts``."""

    octree: SemanticOctree
    scale: float = 1.0
    scan_counts: SemanticOctree | None = None


def gamma_at(consensus: ConsensusConfig, iteration: int) -> float:
    """gamma_k = gamma / (1 + k / gamma_decay)^gamma_power of a robot's own iteration k, counted from 0."""
    return float(consensus.gamma / (1.0 + iteration / consensus.gamma_decay) ** consensus.gamma_power)


def consensus_step(
    own: SemanticOctree,
    neighbours: Sequence[SemanticOctree],
    step_weights: Sequence[float],
    log_likelihood: SemanticOctree,
    *,
    rule: str,
    gamma: float,
    revision: int,
    base: SemanticOctree | None = None,
    last_log_likelihood: SemanticOctree | None = None,
    since: int | None = None,
) -> float:
    """One iteration, in place in ``own``; returns the largest change of a log-odds.

    h~ = h_i + sum_j w_ij (h_j - b_i) over the ``neighbours`` (published maps h_j) with ``step_weights`` w_ij =
    2 epsilon A_ij; ``base`` b_i is the robot's own published map (default: ``own`` itself). Then, with log q_i =
    ``log_likelihood``:

    - ``gradient`` (Alg. 1): h_i = h~ + gamma g, g_c = sigma_c (sum_m sigma_m D_m - D_c), with D = h~ - log q_i and
      sigma = softmax(h~);
    - ``natural``: h_i = h~ + gamma (log q_i - h~);
    - ``bayes``: h_i = h~ + log q_i - ``last_log_likelihood`` (log q_i at the last iteration);
    - ``local``: h_i = log q_i.

    h_i[0] stays 0. Bricks that changed get ``revision``. The result is that of the same step done cell by cell.

    With ``since``, the ``revision`` of an earlier step with the same rule, gamma, weights and neighbours, the bricks
    at rest are skipped: those that no map has given a revision from ``since`` on. That step changed nothing in them,
    so this one would not either. All maps' revisions must then be right, the decoded ones' included.
    """
    columns = [own, own if base is None else base, log_likelihood]
    columns += [log_likelihood if last_log_likelihood is None else last_log_likelihood, *neighbours]
    known_changed = _take_known(own, [(octree, _changed(octree, since)) for octree in (log_likelihood, *neighbours)])
    rows = _changed_rows(own, columns, since)
    codes = own.codes[rows]
    addresses, tiers = address_table(columns, codes)
    needed = _needed_tiers(tiers)
    if (needed > tiers[:, OWN]).any():
        all_needed = own.bricks.tiers[: own.num_bricks].copy()
        all_needed[rows] = needed
        own.raise_tiers(all_needed)
        for column, octree in enumerate(columns):
            if octree is own:
                addresses[:, column], tiers[:, column] = own.addresses(rows)
    changes = np.empty(rows.size, np.float32)
    consensus_kernels.consensus_step(
        addresses,
        tiers,
        np.asarray(step_weights, np.float32),
        _RULES[rule],
        np.float32(gamma),
        own.num_classes,
        scratch_rows(5 * own.num_classes + 3),
        changes,
    )
    all_changes = np.zeros(own.num_bricks, np.float32)
    all_changes[rows] = changes
    consensus_kernels.finish_step(own.bricks, all_changes, known_changed, revision)
    return float(changes.max(initial=0.0))


def _take_known(own: SemanticOctree, sources: Sequence[tuple[SemanticOctree, Int64Array | slice]]) -> UInt8Array:
    """Add the cells of the sources' chosen bricks to the robot's map; a flag (n,) for each brick that this changed."""
    places = [own.find_or_add(source.codes[chosen]) for source, chosen in sources]
    known_changed = np.zeros(own.num_bricks, np.uint8)
    for (source, chosen), indices in zip(sources, places, strict=True):
        known_changed[indices] |= storage.merge_known(own.bricks.known, indices, source.known[chosen])
    return known_changed


def _changed_rows(own: SemanticOctree, octrees: Sequence[SemanticOctree], since: int | None) -> Int64Array:
    """The robot's own bricks (n,) that changed in any of the octrees ``since`` then; None: all of them."""
    if since is None:
        return np.arange(own.num_bricks)
    changed = np.zeros(own.num_bricks, np.bool_)
    for octree in octrees:
        indices = own.find(octree.codes[_changed(octree, since)])
        changed[indices[indices >= 0]] = True
    return np.flatnonzero(changed)


def _changed(octree: SemanticOctree, since: int | None) -> Int64Array | slice:
    """The octree's bricks that changed ``since`` then; None: all of them."""
    return slice(None) if since is None else np.flatnonzero(octree.revisions >= since)


def _needed_tiers(tiers: UInt8Array) -> UInt8Array:
    """The highest tier (n,) that is present in each row of ``tiers`` (n, columns)."""
    needed = np.empty(len(tiers), np.uint8)
    consensus_kernels.needed_tiers(tiers, needed)
    return needed


def scratch_rows(num_rows: int) -> Float32Array:
    """Rows (num_rows, BRICK_CELLS) for a kernel's own use, not set; they start at a cache line.

    A vector instruction that crosses two lines takes twice as long: without this kernels take a third longer.
    """
    line = 64 // 4
    room = np.empty(num_rows * storage.BRICK_CELLS + line, np.float32)
    start = -(room.ctypes.data // 4) % line
    return room[start : start + num_rows * storage.BRICK_CELLS].reshape(num_rows, storage.BRICK_CELLS)


def address_table(octrees: Sequence[SemanticOctree], codes: Int64Array) -> tuple[Int64Array, UInt8Array]:
    """Memory addresses and tiers (n, len(octrees)) of the bricks ``codes`` (n,); valid until an octree grows."""
    addresses = np.empty((codes.size, len(octrees)), np.int64)
    tiers = np.empty((codes.size, len(octrees)), np.uint8)
    first: dict[int, int] = {}
    for column, octree in enumerate(octrees):
        # An octree may be there twice; its second column is a copy.
        same = first.setdefault(id(octree), column)
        if same < column:
            addresses[:, column], tiers[:, column] = addresses[:, same], tiers[:, same]
        else:
            addresses[:, column], tiers[:, column] = octree.addresses(octree.find(codes))
    return addresses, tiers


def sum_of_evidence(target: SemanticOctree, evidence: Sequence[Evidence], codes: Int64Array, revision: int) -> None:
    """Write sum_i log q_i of the bricks ``codes`` (n,) into ``target``: the oracle, or one robot's log q_i.

    All robots read their evidence the same way. Bricks that are written get ``revision``.
    """
    indices = target.find_or_add(codes)
    octrees = [entry.octree for entry in evidence]
    counts = [entry.scan_counts for entry in evidence if entry.scan_counts is not None]
    addresses, tiers = address_table([*octrees, *counts], codes)
    needed = _needed_tiers(tiers)
    all_needed = target.bricks.tiers[: target.num_bricks].copy()
    all_needed[indices] = np.maximum(all_needed[indices], needed)
    target.raise_tiers(all_needed)
    for octree in octrees:
        found = octree.find(codes)
        present = found >= 0
        storage.merge_known(target.bricks.known, indices[present], octree.known[found[present]])
    target_addresses, target_tiers = target.addresses(indices)
    scales: Float32Array = np.array([entry.scale for entry in evidence], np.float32)
    consensus_kernels.sum_evidence(
        addresses, tiers, len(octrees) if counts else -1, scales, target.num_classes, target_addresses, target_tiers
    )
    target.bricks.revisions[indices] = revision
