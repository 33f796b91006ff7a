"""Priors, sensor models, clamps and rules: calibration of their probabilities, and quality of their maps."""

from __future__ import annotations

from typing import Any

from octoreplay.evaluate.temperature import calibrating_temperature
from octoreplay.records import CENTRAL
from octoreplay.report.comparisons import Comparison, Measure, Row
from octoreplay.report.experiment_plots import Dots
from octoreplay.result import open_result
from octoreplay.study.experiments import Experiment, Plan, Question, SimulatedTeam
from octoreplay.study.questions.settings import LAST_MAPS, MEAN_IOU, rule_name, village_of, villages
from octoreplay.study.sweep import Sweep

_NAMES = ("prob_free", "hit", "miss", "hit_other", "clamp_min", "clamp_max")
_DEFAULT = ("-", "-", "-", "-", "-", "-")
_MODELS = {
    "defaults": _DEFAULT,
    "prior p(free) 0.5": ("0.5", "-", "-", "-", "-", "-"),
    "prior p(free) 0.7": ("0.7", "-", "-", "-", "-", "-"),
    "prior p(free) 0.9": ("0.9", "-", "-", "-", "-", "-"),
    "hit 2, miss -0.3": ("-", "2", "-", "-", "-", "-"),
    "hit 0.85, miss -0.4": ("-", "0.85", "-0.4", "-", "-", "-"),
    "hit 1, miss -0.6": ("-", "1", "-0.6", "-", "-", "-"),
    "hit 1, miss -0.15": ("-", "1", "-0.15", "-", "-", "-"),
    "hit_other 0": ("-", "-", "-", "0", "-", "-"),
    "hit_other -1": ("-", "-", "-", "-1", "-", "-"),
    "clamps -2, 3.5": ("-", "-", "-", "-", "-2", "3.5"),
    "clamps -10, 10": ("-", "-", "-", "-", "-10", "10"),
    "prior 0.5, hit 2": ("0.5", "2", "-", "-", "-", "-"),
    "prior 0.5, hit 3": ("0.5", "3", "-", "-", "-", "-"),
    "prior 0.7, hit 2": ("0.7", "2", "-", "-", "-", "-"),
    "prior 0.7, hit 3": ("0.7", "3", "-", "-", "-", "-"),
    "prior 0.7, hit 3, clamps -5, 10": ("0.7", "3", "-", "-", "-", "10"),
}
"""Values of ``_NAMES`` by the name of the model."""


def experiment(duration: float, num_villages: int) -> Experiment:
    """Sensor models with the default rule, and rules with the default sensor model."""
    teams = villages(duration, num_villages)
    models = ",".join("+".join(values) for values in _MODELS.values())
    return Experiment(
        teams,
        (
            Plan(
                "sensor_models", tuple(teams), (f"{'+'.join(_NAMES)}={models}",), LAST_MAPS, keep=True,
                extra_columns=_temperature,
            ),
            Plan("calibration", tuple(teams), ("rule=local,gradient,bayes,flood,merge",), LAST_MAPS),
        ),
    )  # fmt: skip


def _temperature(_: SimulatedTeam, row: Row, sweep: Sweep) -> dict[str, Any]:
    """Temperature that calibrates the centralised map, and the negative log likelihood with it and without."""
    with open_result(sweep.result(dict(row))) as result:
        return calibrating_temperature(result.map(CENTRAL), village_of(result))._asdict()


def _model(row: Row) -> str:
    """Name of a sensor model."""
    values = tuple(str(row[name]) for name in _NAMES)
    return next(name for name, wanted in _MODELS.items() if wanted == values)


_MODELS_COMPARED = Comparison(
    "sensor_models",
    "sensor model",
    _model,
    (
        Measure("mean IoU of all evidence", "central_mean_iou"),
        Measure("calibration error, all cells", "central_calibration_error"),
        Measure("calibration error, occupied", "central_calibration_error_occupied"),
        Measure("log loss, nats", "log_loss"),
        Measure("temperature", "temperature", 2),
    ),
    "defaults",
)
_RULES_COMPARED = Comparison(
    "calibration",
    "rule",
    rule_name,
    (
        MEAN_IOU,
        Measure("calibration error, all cells", "calibration_error"),
        Measure("calibration error, occupied", "calibration_error_occupied"),
    ),
    "bayes",
)

QUESTION = Question(
    experiment,
    (_MODELS_COMPARED, _RULES_COMPARED),
    {"sensor_models.png": Dots(_MODELS_COMPARED), "calibration.png": Dots(_RULES_COMPARED, 9.0)},
)
