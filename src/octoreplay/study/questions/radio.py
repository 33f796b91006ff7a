"""Faults of a radio: the cost of each alone and of all together."""

from __future__ import annotations

from octoreplay.report.comparisons import KILOBYTES, Comparison, Measure, Row
from octoreplay.report.experiment_plots import Dots
from octoreplay.study.experiments import Experiment, Plan, Question
from octoreplay.study.questions.settings import DURING, LAST_MAPS, RADIO_RANGE, SHORT_SETTLING, villages

_FAULTS = {
    ("complete", "0", "0", "none"): "none",
    ("complete", "0.3", "0", "none"): "30 % loss",
    ("complete", "0", "0.2", "none"): "0.2 s delay",
    ("complete", "0", "0", "50000"): "50 kB/s",
    ("range", "0", "0", "none"): "range of 25 m",
    ("range", "0.3", "0.2", "50000"): "all",
}
"""Names by topology, loss, latency and rate."""
_RULES = (
    "gradient+int8+0.02", "bayes+int8+0.02", "weighted+int8+0.02", "ratio+-+-", "flood+int8+0.05", "latest+int8+0.05",
)  # fmt: skip
"""Rule, content and int8_step. 'weighted' has the packets of 'bayes', and 'latest' those of 'flood'."""


def experiment(duration: float, num_villages: int) -> Experiment:
    """Each fault alone, and all together, with the smallest packets of each rule."""
    teams = villages(duration, num_villages)
    vary = (
        f"rule+content+int8_step={','.join(_RULES)}",
        f"topology+loss+latency+rate={','.join('+'.join(values) for values in _FAULTS)}",
    )
    settings = {"radio_range": RADIO_RANGE, **SHORT_SETTLING, **LAST_MAPS}
    return Experiment(teams, (Plan("radio", tuple(teams), vary, settings, has_truth=False),))


def _fault(row: Row) -> str:
    """Name of a radio's faults."""
    return _FAULTS[row["topology"], str(row["loss"]), str(row["latency"]), str(row["rate"])]


_CONNECTED = Measure("agreement when last connected", "agreement_occupied_connected")
_OF_FAULTS = Comparison("radio", "fault", _fault, (DURING, _CONNECTED, KILOBYTES), "none", "rule")

QUESTION = Question(experiment, (_OF_FAULTS,), {"radio.png": Dots(_OF_FAULTS)})
