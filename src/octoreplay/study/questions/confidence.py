"""Priors, sensor models, clamps and rules: calibration of their probabilities, and quality of their maps."""

from __future__ import annotations

from typing import Any

from octoreplay.evaluate.temperature import calibrating_temperature
from octoreplay.records import CENTRAL
from octoreplay.report.comparisons import Comparison, Measure, Row
from octoreplay.report.experiment_plots import Dots
from octoreplay.result import open_result
from octoreplay.study.experiments import Experiment, Plan, Question, SimulatedTeam
from octoreplay.study.questions.sensor_models import PREDICTION, VARY_MODELS, model_name, predicted
from octoreplay.study.questions.settings import LAST_MAPS, MEAN_IOU, rule_name, village_of, villages
from octoreplay.study.sweep import Sweep


def experiment(duration: float, num_villages: int) -> Experiment:
    """Sensor models with the default rule, and rules with the default sensor model."""
    teams = villages(duration, num_villages)
    return Experiment(
        teams,
        (
            Plan(
                "sensor_models", tuple(teams), (VARY_MODELS,), LAST_MAPS, keep=True,
                extra_columns=_fits,
            ),
            Plan("calibration", tuple(teams), ("rule=local,gradient,bayes,flood,merge",), LAST_MAPS),
        ),
    )  # fmt: skip


def _fits(team: SimulatedTeam, row: Row, sweep: Sweep) -> dict[str, Any]:
    """Fit of the centralised map to the truth, and of the others' maps to what each robot measured."""
    with open_result(sweep.result(dict(row))) as result:
        fit = calibrating_temperature(result.map(CENTRAL), village_of(result))
    return {**fit._asdict(), **predicted(team, row, sweep)}


_OF_MODELS = Comparison(
    "sensor_models",
    "sensor model",
    model_name,
    (
        Measure("mean IoU of all evidence", "central_mean_iou"),
        Measure("calibration error, all cells", "central_calibration_error"),
        Measure("calibration error, occupied", "central_calibration_error_occupied"),
        Measure("log loss, nats", "log_loss"),
        Measure("temperature", "temperature", 2),
    ),
    "defaults",
)
_PREDICTED = Comparison("sensor_models", "sensor model", model_name, PREDICTION, "defaults")
_OF_RULES = Comparison(
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
    (_OF_MODELS, _PREDICTED, _OF_RULES),
    {"sensor_models.png": Dots(_OF_MODELS), "calibration.png": Dots(_OF_RULES, 9.0)},
)
