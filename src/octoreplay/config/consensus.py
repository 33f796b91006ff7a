"""Configuration of the consensus rule and its steps."""

from __future__ import annotations

import math
from dataclasses import dataclass

from octoreplay.config.fields import MAX_TICKS, SMALLEST, check_ranges, parameter
from octoreplay.config.rules import RULES, Rule
from octoreplay.errors import ConfigError

EVIDENCES = ("sum", "time-average", "cell-average")
MODES = ("sync", "on-arrival")
FLOW_BITS = 4
"""Default of ``flow_bits`` for packets that hold the maps exactly."""


@dataclass(frozen=True)
class ConsensusConfig:
    """The consensus rule and its steps (docs/algorithm.md)."""

    rule: str = parameter(
        "bayes",
        "consensus rule: bayes (Bayes' rule with averaging), gradient (Alg. 1 of the paper), natural (natural"
        " gradient), ratio and flood (exact in spite of lost packets), merge (baseline that counts evidence"
        " repeatedly), weighted (baseline that weighs cells by certainty), latest (baseline in which the last change"
        " of a cell wins), local (no exchange)",
        choices=tuple(RULES),
        is_common=True,
    )
    evidence: str = parameter(
        "sum",
        "a robot's own evidence log q_i: sum over its scans, time-average over all its scans, or cell-average over the"
        " scans that touched the cell",
        choices=EVIDENCES,
    )
    mode: str = parameter(
        "sync", "one consensus iteration per tick (sync) or per received map (on-arrival)", choices=MODES
    )
    epsilon: float | None = parameter(
        None, "consensus step size (default: 0.5, or 0.9 of the stability bound if that is smaller)", above=0.0
    )
    gamma: float = parameter(0.5, "gradient step size, for the rules gradient and natural", minimum=0.0)
    gamma_power: float = parameter(
        0.0,
        "exponent of gamma's decay: gamma_k = gamma / (1 + k / gamma_decay)^gamma_power (0: constant)",
        minimum=0.0,
        maximum=10.0,
    )
    gamma_decay: float = parameter(1.0, "time constant of gamma's decay [iterations]", above=0.0)
    gamma_per_arrival: str = parameter(
        "divided",
        "mode on-arrival: gamma divided by the number of received maps (divided), or the whole gamma for each (full)",
        choices=("divided", "full"),
    )
    flow_bits: int | None = parameter(
        None,
        "rule bayes: leading bits of the amounts that two robots exchange in a tick; fewer bits let maps come to rest"
        f" earlier; 0: exact amounts (default: {FLOW_BITS}, or 0 where packets do not hold the maps exactly)",
        minimum=0,
        maximum=20,
    )
    flow_gate: float = parameter(
        0.0,
        "rule bayes with flows: a block of 4^3 cells flows over a link only where the labels of a cell differ, or its"
        " log-odds by at least this share of the largest, until the logs end; 1 sends least, 0 holds nothing back",
        minimum=0.0,
        maximum=1.0,
    )
    quantum: float | None = parameter(
        None,
        "smallest step of log-odds, a power of two, for evidence sum and the rules bayes, gradient, natural and"
        " weighted; 0: none (default: 2^-16 for bayes, 2^-10 for the others)",
        minimum=0.0,
    )
    merge_weight: float | None = parameter(
        None, "rule merge: weight of every received map (default: 2 epsilon A_ij, from the graph)", above=0.0
    )
    merge_maps: int | None = parameter(
        None,
        "rule merge: largest number of received maps that a robot merges in a tick, its senders in turn (default: all)",
        minimum=1,
    )
    anchor_after: int = parameter(
        5,
        "rules gradient and natural: number of consecutive packets of a robot that have to be missing before a receiver"
        " keeps what it learned from others (0: never)",
        minimum=0,
    )
    settle: int = parameter(
        20,
        "ticks over which gamma ramps to 0 after the end of the logs (0: no settling)",
        minimum=0,
        maximum=MAX_TICKS,
        is_common=True,
    )
    settle_tolerance: float = parameter(
        1e-6, "settling ends when no log-odds changes by this much in a tick", above=0.0
    )
    settle_max: int | None = parameter(
        None,
        "maximum number of settling ticks (default: derived from the graph's convergence rate)",
        minimum=1,
        maximum=MAX_TICKS,
    )

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.quantum:
            _check_power_of_two(self.quantum)

    @property
    def traits(self) -> Rule:
        """Traits of the rule."""
        return RULES[self.rule]

    @property
    def has_anchor(self) -> bool:
        """True where the pull is anchored while other robots are absent."""
        return self.anchor_after > 0 and self.traits.has_gamma

    @property
    def map_is_mean(self) -> bool:
        """True where robots agree on the mean of their evidence: N times it is the posterior of N robots."""
        return self.traits.map_is_mean and self.evidence == "sum"

    @property
    def effective_quantum(self) -> float:
        """Step of log-odds of the run, a power of two; 0 for rules and readings of evidence without a quantum."""
        if self.evidence != "sum" or self.traits.default_quantum == 0.0:
            return 0.0
        return self.traits.default_quantum if self.quantum is None else self.quantum


def _check_power_of_two(quantum: float) -> None:
    """Raise ConfigError for a quantum that is no power of two or too small."""
    if quantum < SMALLEST:
        raise ConfigError(f"quantum: {quantum:g} is below the least value {SMALLEST:g}; 0 means none")
    if math.frexp(quantum)[0] != 0.5:
        exponent = round(math.log2(quantum))
        raise ConfigError(f"quantum: {quantum:g} is not a power of two; the nearest is 2^{exponent} = {2.0**exponent}")
