"""Which rule, on which graph?"""

from __future__ import annotations

from octoreplay.report.comparisons import Comparison
from octoreplay.report.experiment_plots import Dots
from octoreplay.study.experiments import Experiment, Plan, Question
from octoreplay.study.questions.settings import AGREEMENTS, LAST_MAPS, RADIO_RANGE, rule_name, villages

_RULES = ("local+-", "gradient+0.5", "natural+0.5", "bayes+-", "ratio+-", "flood+-", "merge+-")


def experiment(duration: float, num_villages: int) -> Experiment:
    """Every rule on a complete graph and on the graph of a limited radio range, with the default packets."""
    teams = villages(duration, num_villages)
    vary = (f"rule+gamma={','.join(_RULES)}", "topology=complete,range")
    return Experiment(teams, (Plan("rules", tuple(teams), vary, {"radio_range": RADIO_RANGE, **LAST_MAPS}),))


_COMPARISON = Comparison("rules", "rule", rule_name, AGREEMENTS, "bayes", "topology")

QUESTION = Question(experiment, (_COMPARISON,), {"rules.png": Dots(_COMPARISON)})
