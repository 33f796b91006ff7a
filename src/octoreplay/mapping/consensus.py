"""One iteration of a consensus rule at one robot (Alg. 1 of Asgharivaskasi and Atanasov, and its relatives)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from octoreplay.config import ConsensusConfig
from octoreplay.mapping.kernels import consensus as consensus_kernels
from octoreplay.mapping.kernels import storage
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
    """
    sources = (log_likelihood, *neighbours)
    known_changed = _take_known(own, sources)
    codes = own.codes
    columns = [own, own if base is None else base, log_likelihood]
    columns += [log_likelihood if last_log_likelihood is None else last_log_likelihood, *neighbours]
    _, tiers = address_table(columns, codes)
    needed = np.empty(codes.size, np.uint8)
    consensus_kernels.needed_tiers(tiers, needed)
    own.raise_tiers(needed)
    addresses, tiers = address_table(columns, codes)
    changes = np.empty(codes.size, np.float32)
    consensus_kernels.consensus_step(
        addresses,
        tiers,
        np.asarray(step_weights, np.float32),
        _RULES[rule],
        np.float32(gamma),
        own.num_classes,
        changes,
    )
    consensus_kernels.finish_step(own.bricks, changes, known_changed, revision)
    return float(changes.max(initial=0.0))


def _take_known(own: SemanticOctree, sources: Sequence[SemanticOctree]) -> UInt8Array:
    """Add the cells that the sources know to the robot's map; a flag (n,) for each brick where that changed it."""
    indices = [own.find_or_add(source.codes) for source in sources]
    changed = np.zeros(own.num_bricks, np.uint8)
    for source, places in zip(sources, indices, strict=True):
        changed[places] |= storage.merge_known(own.bricks.known, places, source.known)
    return changed


def address_table(octrees: Sequence[SemanticOctree], codes: Int64Array) -> tuple[Int64Array, UInt8Array]:
    """Memory addresses and tiers (n, len(octrees)) of the bricks ``codes`` (n,); valid until an octree grows."""
    addresses = np.empty((codes.size, len(octrees)), np.int64)
    tiers = np.empty((codes.size, len(octrees)), np.uint8)
    for column, octree in enumerate(octrees):
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
    needed = np.empty(codes.size, np.uint8)
    consensus_kernels.needed_tiers(tiers, needed)
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
