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

    rule: str = parameter("gradient", "consensus rule", choices=tuple(RULES))
    evidence: str = parameter("sum", "reading of log q_i", choices=EVIDENCES)
    mode: str = parameter("sync", "one iteration per tick, or one per arriving map", choices=MODES)
    epsilon: float | None = parameter(
        None, "consensus step size (default: 0.5, or 0.9 of the bound where that is less)", above=0.0
    )
    gamma: float = parameter(0.5, "gradient step size", minimum=0.0)
    gamma_power: float = parameter(0.0, "gamma_k = gamma / (1 + k / gamma_decay)^gamma_power", minimum=0.0)
    gamma_decay: float = parameter(1.0, "iterations after which gamma starts to fall", above=0.0)
    gamma_per_arrival: str = parameter(
        "divided", "on-arrival: gamma divided by the robot's degree, or full", choices=("divided", "full")
    )
    settle: int = parameter(20, "ticks over which gamma ramps to 0 after the last log; 0: no settling", minimum=0)
    settle_tolerance: float = parameter(
        1e-6, "settling stops when no log-odds changes by more than this in a tick", above=0.0
    )
    settle_max: int | None = parameter(None, "most settling ticks (default: 20 + 12 / -log10 lambda_2)", minimum=1)

    def __post_init__(self) -> None:
        check_ranges(self)

    @property
    def traits(self) -> Rule:
        """Traits of the rule."""
        return RULES[self.rule]
