"""Knowledge that a robot keeps after it is cut off, and a team that separates and meets again."""

from __future__ import annotations

import dataclasses

from octoreplay.config.network import ScheduleEntry
from octoreplay.report.comparisons import Comparison, Measure, Row
from octoreplay.report.experiment_plots import Dots
from octoreplay.result import open_result
from octoreplay.study.experiments import Experiment, ExperimentTeam, Plan, Question
from octoreplay.study.numbers import worst
from octoreplay.study.questions.settings import DURING, LAST_MAPS, SETTLED, villages
from octoreplay.study.sweep import Sweep

_VARIANTS = {
    ("gradient", "1", "0", "0"): "gradient, γ 1",
    ("gradient", "0.5", "0", "0"): "gradient, γ 0.5",
    ("gradient", "0.1", "0", "0"): "gradient, γ 0.1",
    ("gradient", "1", "1", "0"): "gradient, γ 1/k",
    ("gradient", "0.5", "0", "5"): "gradient, γ 0.5, anchored",
    ("natural", "0.5", "0", "0"): "natural, γ 0.5",
    ("natural", "0.5", "0", "5"): "natural, γ 0.5, anchored",
    ("bayes", "-", "-", "-"): "bayes",
    ("flood", "-", "-", "-"): "flood",
}
"""Names by rule, gamma, gamma_power and anchor_after."""
_VARY = f"rule+gamma+gamma_power+anchor_after={','.join('+'.join(values) for values in _VARIANTS)}"

_IDLE_TICKS = (0, 100, 300)
"""Numbers of idle ticks after the logs, ascending, after which the maps are compared."""
_CONSTANT_GAMMA = 100_000
"""Number of settling ticks over which gamma falls to 0: it is constant within 1 % over the idle ticks."""
_CUT = 1.5
"""Time before the end of the logs at which a robot is cut off [s], so that the last graph is without it."""


def experiment(duration: float, num_villages: int) -> Experiment:
    """A robot that is cut off when the logs end, and a team that is in two halves for a third of the logs."""
    cut = ScheduleEntry(start=duration - _CUT, groups=(("husky_1",), tuple(f"husky_{n}" for n in range(2, 7))))
    halves = ScheduleEntry(
        start=duration / 3, end=2 * duration / 3,
        groups=(tuple(f"husky_{n}" for n in (1, 2, 3)), tuple(f"husky_{n}" for n in (4, 5, 6))),
    )  # fmt: skip
    teams = villages(duration, num_villages)
    with_cut = {f"cut_{label}": dataclasses.replace(team, schedule=(cut,)) for label, team in teams.items()}
    with_halves = {f"halves_{label}": dataclasses.replace(team, schedule=(halves,)) for label, team in teams.items()}
    idle = {"settle": _CONSTANT_GAMMA, "settle_tolerance": 1e-12, "settle_max": _IDLE_TICKS[-1], **LAST_MAPS}
    return Experiment(
        {**with_cut, **with_halves},
        (
            Plan("cut", tuple(with_cut), (_VARY,), idle, has_truth=False, keep=True, extra_columns=_kept),
            Plan("halves", tuple(with_halves), (_VARY,), LAST_MAPS, has_truth=False),
        ),
    )


def _kept(_: ExperimentTeam, row: Row, sweep: Sweep) -> dict[str, float]:
    """Agreement of the worst robot over the occupied cells after each number of idle ticks.

    A team that came to rest stays as it is.
    """
    with open_result(sweep.result(dict(row))) as result:
        ticks = result.metrics
    log_end = sum(not tick.settling for tick in ticks) - 1
    return {
        f"agreement_occupied_idle_{count}": worst(ticks[min(log_end + count, len(ticks) - 1)], "agreement_occupied")
        for count in _IDLE_TICKS
    }


def _variant(row: Row) -> str:
    """Name of a run's rule and steps."""
    return _VARIANTS[row["rule"], str(row["gamma"]), str(row["gamma_power"]), str(row["anchor_after"])]


_CUT_OFF = Comparison(
    "cut",
    "rule",
    _variant,
    tuple(Measure(f"agreement after {count} idle ticks", f"agreement_occupied_idle_{count}") for count in _IDLE_TICKS),
    "bayes",
    title="one robot without links",
)
_HALVES = Comparison("halves", "rule", _variant, (DURING, SETTLED), "bayes", title="two halves apart and rejoined")

QUESTION = Question(
    experiment,
    (_CUT_OFF, _HALVES),
    {"cut.png": Dots(_CUT_OFF), "halves.png": Dots(_HALVES, 9.0)},
)
