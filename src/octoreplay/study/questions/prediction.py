"""Sensor models on real recordings: how well the others' maps predict what a robot measures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from octoreplay.report.comparisons import Comparison
from octoreplay.report.experiment_plots import Dots
from octoreplay.study.experiments import Experiment, Plan, Question
from octoreplay.study.questions.sensor_models import PREDICTION, VARY_MODELS, model_name, predicted
from octoreplay.study.questions.settings import LAST_MAPS
from octoreplay.study.real_teams import teams_of
from octoreplay.study.team_frames import RIGHT


def experiment(data: Sequence[Path]) -> Experiment:
    """Sensor models on each team of the data, with right frames and without exchange."""
    teams = teams_of(data, (RIGHT,))
    settings = {"rule": "local", "settle": 0, **LAST_MAPS}
    return Experiment(
        teams,
        (
            Plan(
                "prediction", tuple(teams), (VARY_MODELS,), settings, has_truth=False, keep=True,
                extra_columns=predicted,
            ),
        ),
    )  # fmt: skip


_COMPARISON = Comparison("prediction", "sensor model", model_name, PREDICTION, "defaults", unit="team")

QUESTION = Question(experiment, (_COMPARISON,), {"prediction.png": Dots(_COMPARISON)})
