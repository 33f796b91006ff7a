"""Faults of a radio: the cost of each alone and of all together."""

from __future__ import annotations

from octoreplay.report.comparisons import KILOBYTES, Comparison, Measure, Row
from octoreplay.report.experiment_plots import Dots
from octoreplay.study.experiments import Experiment, ExperimentTeam, Plan, Question
from octoreplay.study.questions.settings import DURING, LAST_MAPS, MEAN_IOU, RADIO_RANGE, SHORT_SETTLING, villages
from octoreplay.study.sweep import Sweep

_FAULTS = {
    ("complete", "0", "0", "none"): "none",
    ("complete", "0.3", "0", "none"): "30 % loss",
    ("complete", "0", "0.2", "none"): "0.2 s delay",
    ("complete", "0", "0", "50000"): "50 kB/s",
    ("range", "0", "0", "none"): "range of 25 m",
    ("range", "0.3", "0.2", "50000"): "all",
}
"""Names by topology, loss, latency and rate."""
_RULES = ("gradient+int8", "bayes+int8", "bayes+float32", "weighted+int8", "ratio+-", "flood+int8", "latest+int8")
"""Rule and content."""


def experiment(duration: float, num_villages: int) -> Experiment:
    """Each fault alone, and all together, with the smallest packets of each rule, and the default ones of 'bayes'."""
    teams = villages(duration, num_villages)
    vary = (
        f"rule+content={','.join(_RULES)}",
        f"topology+loss+latency+rate={','.join('+'.join(values) for values in _FAULTS)}",
    )
    settings = {"radio_range": RADIO_RANGE, **SHORT_SETTLING, **LAST_MAPS}
    return Experiment(teams, (Plan("radio", tuple(teams), vary, settings, extra_columns=_rule_and_packets),))


def _rule_and_packets(_: ExperimentTeam, row: Row, __: Sweep) -> dict[str, str]:
    """Name of a run's rule, with that of its packets where these are not the smallest ones."""
    return {"rule_and_packets": f"{row['rule']}, float32" if row["content"] == "float32" else row["rule"]}


def _fault(row: Row) -> str:
    """Name of a radio's faults."""
    return _FAULTS[row["topology"], str(row["loss"]), str(row["latency"]), str(row["rate"])]


_CONNECTED = Measure("agreement when last connected", "agreement_occupied_connected")
_OF_FAULTS = Comparison("radio", "fault", _fault, (DURING, _CONNECTED, MEAN_IOU, KILOBYTES), "none", "rule_and_packets")

QUESTION = Question(experiment, (_OF_FAULTS,), {"radio.png": Dots(_OF_FAULTS)})
