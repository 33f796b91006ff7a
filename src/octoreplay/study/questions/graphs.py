"""Graphs: what the hops between robots cost each rule."""

from __future__ import annotations

from octoreplay.report.comparisons import Comparison
from octoreplay.report.experiment_plots import Dots
from octoreplay.study.experiments import Experiment, Plan, Question
from octoreplay.study.questions.settings import AGREEMENTS, LAST_MAPS, graph_name, villages

_RULES = ("gradient", "natural", "bayes", "flood")
_GRAPHS = ("complete", "star", "ring", "line")


def experiment(duration: float, num_villages: int) -> Experiment:
    """Rules with their default packets on graphs of one to five hops."""
    teams = villages(duration, num_villages)
    vary = (f"rule={','.join(_RULES)}", f"topology={','.join(_GRAPHS)}")
    return Experiment(teams, (Plan("graphs", tuple(teams), vary, LAST_MAPS),))


_COMPARISON = Comparison("graphs", "graph", graph_name, AGREEMENTS, "complete", "rule")

QUESTION = Question(experiment, (_COMPARISON,), {"graphs.png": Dots(_COMPARISON)})
