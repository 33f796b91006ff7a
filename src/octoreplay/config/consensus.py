"""Configuration of the consensus rule and its steps."""

from __future__ import annotations

from dataclasses import dataclass

from octoreplay.config.fields import check_ranges, parameter
from octoreplay.config.rules import RULES, Rule

EVIDENCES = ("sum", "time-average", "cell-average")
MODES = ("sync", "on-arrival")


@dataclass(frozen=True)
class ConsensusConfig:
    """The consensus rule and its steps (docs/algorithm.md)."""

    rule: str = parameter(
        "gradient",
        "consensus rule: gradient (the paper's), bayes (Bayes' rule with averaging), natural (natural gradient), ratio"
        " and flood (exact in spite of lost packets), merge (baseline that counts evidence repeatedly), local (no"
        " exchange)",
        choices=tuple(RULES),
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
        0.0, "exponent of gamma's decay: gamma_k = gamma / (1 + k / gamma_decay)^gamma_power (0: constant)", minimum=0.0
    )
    gamma_decay: float = parameter(1.0, "time constant of gamma's decay [iterations]", above=0.0)
    gamma_per_arrival: str = parameter(
        "divided",
        "mode on-arrival: gamma divided by the number of received maps (divided), or the whole gamma for each (full)",
        choices=("divided", "full"),
    )
    settle: int = parameter(
        20, "ticks over which gamma ramps to 0 after the end of the logs (0: no settling)", minimum=0
    )
    settle_tolerance: float = parameter(
        1e-6, "settling ends when no log-odds changes by this much in a tick", above=0.0
    )
    settle_max: int | None = parameter(
        None, "maximum number of settling ticks (default: derived from the graph's convergence rate)", minimum=1
    )

    def __post_init__(self) -> None:
        check_ranges(self)

    @property
    def traits(self) -> Rule:
        """Traits of the rule."""
        return RULES[self.rule]
