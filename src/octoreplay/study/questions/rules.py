"""Consensus rules on a complete graph and within a radio range."""

from __future__ import annotations

from octoreplay.report.comparisons import Comparison, Row
from octoreplay.report.experiment_plots import Dots
from octoreplay.study.experiments import Experiment, Plan, Question
from octoreplay.study.questions.settings import AGREEMENTS, LAST_MAPS, RADIO_RANGE, villages

_RULES = ("local", "gradient", "natural", "bayes", "ratio", "flood", "merge", "weighted", "latest")


def experiment(duration: float, num_villages: int) -> Experiment:
    """Every rule and ROAM's exchange on a complete graph and within a radio range, with each rule's default packets."""
    teams = villages(duration, num_villages)
    variants = ",".join(f"-+{rule}" for rule in _RULES)
    vary = (f"preset+rule={variants},roam+-", "topology=complete,range")
    return Experiment(teams, (Plan("rules", tuple(teams), vary, {"radio_range": RADIO_RANGE, **LAST_MAPS}),))


def _rule(row: Row) -> str:
    """Name of a run's rule or preset."""
    return "--preset roam" if row["preset"] == "roam" else str(row["rule"])


_COMPARISON = Comparison("rules", "rule", _rule, AGREEMENTS, "bayes", "topology")

QUESTION = Question(experiment, (_COMPARISON,), {"rules.png": Dots(_COMPARISON, without=("local",))})
