"""Packet formats: bytes and agreement, with six robots and with sixteen."""

from __future__ import annotations

from octoreplay.report.comparisons import Comparison, Row
from octoreplay.report.experiment_plots import Dots
from octoreplay.study.experiments import Experiment, Plan, Question
from octoreplay.study.questions.settings import AGREEMENTS, LAST_MAPS, SHORT_SETTLING, villages

_NUM_ROBOTS = 16
_FORMATS = ("full+float32+-", "delta+float32+-", "delta+float16+-", "delta+int8+0.05", "delta+int8+0.02")
_FLOWS = {"0": ", exact amounts", "4": ", flows of 4 bits"}


def experiment(duration: float, num_villages: int) -> Experiment:
    """Rules and packet formats on a good radio; sixteen robots are linked to their three nearest."""
    six = villages(duration, num_villages)
    many = {f"many_{label}": team for label, team in villages(duration, num_villages, num_robots=_NUM_ROBOTS).items()}
    formats = ",".join(
        f"{rule}+{sent}+{'0' if rule == 'bayes' else '-'}"
        for rule in ("gradient", "bayes", "flood")
        for sent in _FORMATS
    )
    vary = (f"rule+packets+content+int8_step+flow_bits={formats},bayes+delta+float32+-+4",)
    nearest = {"topology": "nearest", "num_nearest": 3, **SHORT_SETTLING, **LAST_MAPS}
    return Experiment(
        {**six, **many},
        (Plan("six_robots", tuple(six), vary, LAST_MAPS), Plan("sixteen_robots", tuple(many), vary, nearest)),
    )


def _format(row: Row) -> str:
    """Name of a packet format."""
    step = "" if row["int8_step"] == "-" else f" {row['int8_step']}"
    return f"{row['packets']} {row['content']}{step}{_FLOWS.get(str(row['flow_bits']), '')}"


def _exact(row: Row) -> str:
    """Name of a packet format, without the flows that belong to every format of a rule."""
    return _format(row).removesuffix(_FLOWS["0"])


_COMPARISONS = tuple(
    Comparison(plan, "packets", _exact, AGREEMENTS, "delta float32", "rule", title=plan.replace("_", " "))
    for plan in ("six_robots", "sixteen_robots")
)

QUESTION = Question(
    experiment, _COMPARISONS, {f"{comparison.plan}.png": Dots(comparison) for comparison in _COMPARISONS}
)
