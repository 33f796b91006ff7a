"""Priors, sensor models, confidences and rules: calibration of their probabilities, and quality of their maps."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

from octoreplay.evaluate.temperature import calibrating_temperature
from octoreplay.records import CENTRAL
from octoreplay.report.comparisons import Comparison, Measure, Row
from octoreplay.report.experiment_plots import Dots
from octoreplay.result import open_result
from octoreplay.simulate.settings import SimulationConfig
from octoreplay.study.experiments import Experiment, Plan, Question, SimulatedTeam
from octoreplay.study.questions.sensor_models import PREDICTION, VARY_MODELS, model_name, predicted
from octoreplay.study.questions.settings import AGREEMENTS, LAST_MAPS, MEAN_IOU, rule_name, village_of, villages
from octoreplay.study.sweep import Sweep

_NETWORKS: dict[str, dict[str, Any]] = {
    "10 % of labels wrong": {"label_noise": 0.1, "confidences": 1.0},
    "30 % of labels wrong": {"label_noise": 0.3, "confidences": 1.0},
    "30 % of labels wrong, confidences too high": {"label_noise": 0.3, "confidences": 0.5},
}
"""Settings of the simulation by the name of the network."""
_CONFIDENCES = {
    "hit": ("hit", "-"),
    "ignored": ("none", "-"),
    "tempered": ("tempered", "-"),
    "mixture": ("mixture", "-"),
    "hit, hit_other 0": ("hit", "0"),
}
"""Values of ``confidence_model`` and ``hit_other`` by name."""
_CALIBRATED = {"prob_free": 0.7, "hit": 3.0}
"""Prior and hit with calibrated probabilities (``prior 0.7, hit 3``)."""
_LABELS = {"defaults": ("-", "-"), "prior 0.5, hit 3": ("0.5", "3"), "prior 0.7, hit 3": ("0.7", "3")}
"""Values of ``prob_free`` and ``hit`` by name, for labels while the logs last."""
_VARY_LABELS = f"prob_free+hit={','.join('+'.join(values) for values in _LABELS.values())}"


def experiment(duration: float, num_villages: int) -> Experiment:
    """Sensor models with the default rule, rules with the default sensor model, and confidence models."""
    teams = villages(duration, num_villages)
    unsure = _unsure_teams(duration, num_villages)
    return Experiment(
        {**teams, **unsure},
        (
            Plan("sensor_models", tuple(teams), (VARY_MODELS,), LAST_MAPS, keep=True, extra_columns=_fits),
            Plan("calibration", tuple(teams), ("rule=local,gradient,bayes,flood,merge",), LAST_MAPS),
            Plan("labels", tuple(teams), ("rule=gradient,natural,bayes,flood", _VARY_LABELS), LAST_MAPS),
            *_confidence_plans(tuple(unsure)),
        ),
    )  # fmt: skip


def _unsure_teams(duration: float, num_villages: int) -> dict[str, SimulatedTeam]:
    """Teams by label, whose networks give confidences."""
    return {
        f"network_{index}_{seed}": SimulatedTeam(SimulationConfig(duration=duration, seed=seed, **values))
        for index, values in enumerate(_NETWORKS.values())
        for seed in range(num_villages)
    }


def _confidence_plans(teams: tuple[str, ...]) -> Iterator[Plan]:
    """Confidence models with the default sensor model for all teams, and with calibrated numbers for one network."""
    vary = (f"confidence_model+hit_other={','.join('+'.join(values) for values in _CONFIDENCES.values())}",)
    # The centralised map, which is compared, needs no exchange.
    settings = {**LAST_MAPS, "rule": "local"}
    yield Plan("confidences", teams, vary, settings, keep=True, extra_columns=_network)
    teams = tuple(label for label in teams if label.startswith("network_1_"))
    yield Plan("confidences_prior", teams, vary, {**settings, **_CALIBRATED}, keep=True, extra_columns=_network)


def _fit(row: Row, sweep: Sweep) -> dict[str, Any]:
    """Fit of the centralised map to the truth."""
    with open_result(sweep.result(dict(row))) as result:
        return calibrating_temperature(result.map(CENTRAL), village_of(result))._asdict()


def _fits(team: SimulatedTeam, row: Row, sweep: Sweep) -> dict[str, Any]:
    """Fit of the centralised map to the truth, and of the others' maps to what each robot measured."""
    return {**_fit(row, sweep), **predicted(team, row, sweep)}


def _network(team: SimulatedTeam, row: Row, sweep: Sweep) -> dict[str, Any]:
    """Name of a team's network, and the fit of the centralised map to the truth."""
    given = {"label_noise": team.simulation.label_noise, "confidences": team.simulation.confidences}
    name = next(name for name, values in _NETWORKS.items() if values == given)
    return {"network": name, **_fit(row, sweep)}


def _confidence_model(row: Row) -> str:
    """Name of what confidences change."""
    wanted = (str(row["confidence_model"]), str(row["hit_other"]))
    return next(name for name, values in _CONFIDENCES.items() if values == wanted)


def _label_model(row: Row) -> str:
    """Name of a prior and a hit."""
    wanted = (str(row["prob_free"]), str(row["hit"]))
    return next(name for name, values in _LABELS.items() if values == wanted)


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
    title="sensor models, against the truth",
)
_PREDICTED = Comparison(
    "sensor_models", "sensor model", model_name, PREDICTION, "defaults", title="sensor models, prediction"
)
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
    title="rules",
)
_OF_LABELS = Comparison("labels", "sensor model", _label_model, AGREEMENTS, "defaults", "rule", title="priors")
_OF_CONFIDENCES = Comparison(
    "confidences", "confidences", _confidence_model, _OF_MODELS.measures, "hit", "network", title="confidences"
)
_OF_CONFIDENCES_WITH_PRIOR = dataclasses.replace(
    _OF_CONFIDENCES, plan="confidences_prior", title="confidences, prior 0.7, hit 3"
)

QUESTION = Question(
    experiment,
    (_OF_MODELS, _PREDICTED, _OF_RULES, _OF_LABELS, _OF_CONFIDENCES, _OF_CONFIDENCES_WITH_PRIOR),
    {
        "sensor_models.png": Dots(_OF_MODELS),
        "calibration.png": Dots(_OF_RULES, 9.0),
        "labels.png": Dots(_OF_LABELS),
        "confidences.png": Dots(_OF_CONFIDENCES),
        "confidences_prior.png": Dots(_OF_CONFIDENCES_WITH_PRIOR),
    },
)
