"""Sensor models that are compared, and how well the others' maps predict with each what a robot measures."""

from __future__ import annotations

from typing import Any

from octoreplay.evaluate.held_out import prediction
from octoreplay.mapping.contradiction import state_limits
from octoreplay.report.comparisons import Measure, Row
from octoreplay.result import open_result
from octoreplay.study.experiments import ExperimentTeam
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
VARY_MODELS = f"{'+'.join(_NAMES)}={','.join('+'.join(values) for values in _MODELS.values())}"

PREDICTION = (
    Measure("IoU of occupied cells", "held_out_iou"),
    Measure("calibration error", "held_out_calibration_error"),
    Measure("log loss, nats", "held_out_log_loss"),
    Measure("temperature", "held_out_temperature", 2),
)
"""Measures of ``predicted``."""


def model_name(row: Row) -> str:
    """Return the name of a run's sensor model."""
    values = tuple(str(row[name]) for name in _NAMES)
    return next(name for name, wanted in _MODELS.items() if wanted == values)


def predicted(_: ExperimentTeam, row: Row, sweep: Sweep) -> dict[str, Any]:
    """Return ``held_out_`` columns: fit of the others' maps to what each robot measured with the default model.

    A team without a cell in common has none.
    """
    with open_result(sweep.result(dict(row))) as own:
        evidence = [own.evidence(robot_id) for robot_id in own.robots]
        prior = own.config.map.prior(own.class_table.num_classes)
    with open_result(sweep.result({**row, **dict(zip(_NAMES, _DEFAULT, strict=True))})) as default:
        measured = [default.evidence(robot_id).octree for robot_id in default.robots]
        limits = state_limits(default.config.sensor)
    found = prediction([stored.octree for stored in evidence], prior, measured, limits)
    return {} if found is None else {f"held_out_{name}": value for name, value in found._asdict().items()}
