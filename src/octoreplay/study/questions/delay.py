"""Delays of a radio: what they cost with ticks as long as the period of publishing, and with finer ones."""

from __future__ import annotations

import dataclasses

from octoreplay.report.comparisons import KILOBYTES, Comparison, Row
from octoreplay.report.experiment_plots import Dots
from octoreplay.study.experiments import Experiment, Plan, Question
from octoreplay.study.questions.settings import DURING, LAST_MAPS, SETTLED, SHORT_SETTLING, villages

_DELAYS = {
    ("1", "0"): "ticks of 1 s, no delay",
    ("1", "0.2"): "ticks of 1 s, 0.2 s delay",
    ("0.2", "0"): "ticks of 0.2 s, no delay",
    ("0.2", "0.2"): "ticks of 0.2 s, 0.2 s delay",
}
"""Names by the length of a tick, which is called publish_period, and latency; all robots publish once a second."""
_RULES = ("gradient", "bayes", "flood")


def experiment(duration: float, num_villages: int) -> Experiment:
    """A delay of 0.2 s with ticks of 1 s and of 0.2 s; every robot publishes once a second."""
    teams = {
        label: dataclasses.replace(team, publish_period=1.0) for label, team in villages(duration, num_villages).items()
    }
    vary = (
        f"rule={','.join(_RULES)}",
        f"publish_period+latency={','.join('+'.join(values) for values in _DELAYS)}",
    )
    settings = {"content": "int8", **SHORT_SETTLING, **LAST_MAPS}
    return Experiment(teams, (Plan("delay", tuple(teams), vary, settings, has_truth=False),))


def _delay(row: Row) -> str:
    """Name of a tick and a delay."""
    return _DELAYS[str(row["publish_period"]), str(row["latency"])]


_COMPARISON = Comparison(
    "delay", "ticks and delay", _delay, (DURING, SETTLED, KILOBYTES), "ticks of 1 s, no delay", "rule"
)

QUESTION = Question(experiment, (_COMPARISON,), {"delay.png": Dots(_COMPARISON)})
