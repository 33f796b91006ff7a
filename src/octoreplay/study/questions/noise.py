"""Wrong labels, poses and depths that the exchange repairs, and those that it spreads."""

from __future__ import annotations

from typing import Any

from octoreplay.evaluate.repairs import repairs
from octoreplay.report.comparisons import Comparison, Measure, Row
from octoreplay.report.experiment_plots import Dots
from octoreplay.result import open_result
from octoreplay.simulate.settings import SimulationConfig
from octoreplay.study.experiments import Experiment, Plan, Question, SimulatedTeam
from octoreplay.study.questions.settings import LAST_MAPS, MEAN_IOU, village_of
from octoreplay.study.sweep import Sweep

_CLEAN: dict[str, Any] = {"label_noise": 0.0}
_LEVELS: dict[str, dict[str, Any]] = {
    "no noise of labels": _CLEAN,
    **{f"{100 * share:g} % of pixels wrong": {"label_noise": share} for share in (0.1, 0.2, 0.4)},
    **{
        f"{100 * share:g} % of pixels confused": {"label_noise": share, "similar_errors": True}
        for share in (0.1, 0.2, 0.4)
    },
    **{f"{100 * share:g} % of places wrong": {**_CLEAN, "patchy_noise": share} for share in (0.1, 0.2, 0.4)},
    **{f"poses off by {noise:g} m": {**_CLEAN, "pose_noise": noise} for noise in (0.1, 0.4)},
    **{f"{noise:g} times the noise of depths": {**_CLEAN, "depth_noise": noise} for noise in (2.0, 4.0)},
}
"""Settings of the simulation by name; each changes one kind of noise."""


def experiment(duration: float, num_villages: int) -> Experiment:
    """Each kind of noise at several levels, without exchange and with two rules."""
    teams = {
        f"{index}_{seed}": SimulatedTeam(SimulationConfig(duration=duration, seed=seed, **values))
        for index, values in enumerate(_LEVELS.values())
        for seed in range(num_villages)
    }
    return Experiment(
        teams,
        (Plan("noise", tuple(teams), ("rule=local,gradient,bayes",), LAST_MAPS, keep=True, extra_columns=_changes),),
    )


def _changes(team: SimulatedTeam, row: Row, sweep: Sweep) -> dict[str, Any]:
    """Name of a team's noise, and the shares of its cells that are wrong, repaired and spoiled (``Repairs``)."""
    with open_result(sweep.result({**row, "rule": "local"})) as own, open_result(sweep.result(dict(row))) as after:
        truth = village_of(own)
        counts = [repairs(own.map(robot_id), after.map(robot_id), truth) for robot_id in own.robots]
    num_cells, *changes = (sum(count) for count in zip(*counts, strict=True))
    shares = dict(zip(("wrong", "repaired", "spread"), (change / num_cells for change in changes), strict=True))
    name = next(
        name for name, values in _LEVELS.items()
        if team.simulation == SimulationConfig(duration=team.simulation.duration, seed=team.simulation.seed, **values)
    )  # fmt: skip
    return {"noise": name, **shares, "wrong_after": shares["wrong"] - shares["repaired"] + shares["spread"]}


def _noise(row: Row) -> str:
    """Name of a team's noise."""
    return str(row["noise"])


_COMPARISON = Comparison(
    "noise",
    "noise",
    _noise,
    (
        Measure("wrong in own map, %", "wrong", 2, 100.0),
        Measure("repaired, %", "repaired", 2, 100.0),
        Measure("made wrong, %", "spread", 2, 100.0),
        Measure("wrong after the exchange, %", "wrong_after", 2, 100.0),
        MEAN_IOU,
    ),
    next(iter(_LEVELS)),
    "rule",
)

QUESTION = Question(experiment, (_COMPARISON,), {"noise.png": Dots(_COMPARISON, 15.0)})
