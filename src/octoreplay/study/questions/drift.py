"""Quality of maps with wrong poses, as recorded and after the repair of drift."""

from __future__ import annotations

from pathlib import Path
from statistics import fmean
from typing import Any

from octoreplay.evaluate.morton_intervals import Region
from octoreplay.records import CENTRAL
from octoreplay.report.comparisons import Comparison, Measure, Row
from octoreplay.report.experiment_plots import Contrasts
from octoreplay.result import open_result
from octoreplay.study.experiments import Experiment, Plan, Question
from octoreplay.study.questions.settings import LAST_MAPS, counts_of, folder_of_logs, small_village, village_of
from octoreplay.study.refined_teams import POSES, RECORDED, REFINED, RefinedTeam, pose_errors
from octoreplay.study.sweep import Sweep

_DRIFTS = (0.1, 0.5, 1.0, 2.0, 4.0)
"""Drifts of odometry in position [% of the way]; those of the heading are half the number [degrees per 10 m]."""
_NOISES = (0.1, 0.2, 0.4)
"""Standard deviations of the noise of positions [m]."""


def experiment(duration: float, num_villages: int) -> Experiment:
    """Four robots with drift of odometry, and with noise of poses, each with and without the repair."""
    levels: dict[str, dict[str, dict[str, Any]]] = {
        "drift": {f"drift_{drift:g}": {"odometry_drift": (drift, drift / 2.0)} for drift in _DRIFTS},
        "noise": {f"noise_{noise:g}": {"pose_noise": noise} for noise in _NOISES},
    }
    plans = {
        plan: {
            f"{name}_{poses}_{seed}": RefinedTeam(small_village(duration, seed, own_frames=False, **values), poses)
            for name, values in settings.items()
            for seed in range(num_villages)
            for poses in (RECORDED, REFINED)
        }
        for plan, settings in levels.items()
    }
    # The evidence of each robot and its sum are what counts, and no rule changes them.
    run = {"rule": "local", "settle": 0, **LAST_MAPS}
    return Experiment(
        {label: team for teams in plans.values() for label, team in teams.items()},
        tuple(
            Plan(plan, tuple(teams), (), run, has_truth=False, keep=True, extra_columns=_quality)
            for plan, teams in plans.items()
        ),
    )


def _quality(team: RefinedTeam, row: Row, sweep: Sweep) -> dict[str, Any]:
    """Numbers of a run with the kind of its poses in their names; with refined poses also what the repair gained."""
    simulation = team.simulation
    scores = _scores(sweep.result(dict(row)), team.poses)
    columns: dict[str, Any] = {
        "drift": simulation.odometry_drift[0], "pose_noise": simulation.pose_noise,
        **{f"{name}_{team.poses}": value for name, value in scores.items()},
        f"clear_{team.poses}": row["clear_contradiction"],
    }  # fmt: skip
    if team.poses == RECORDED:
        return columns
    before = _scores(sweep.result({**row, "team": str(Path(row["team"]).with_name(POSES[RECORDED]))}), RECORDED)
    gains = {f"{name}_gain": value - before[name] for name, value in scores.items()}
    return {**columns, **gains}


def _scores(path: Path, poses: str) -> dict[str, float]:
    """Error of the poses, share of corrected robots, and IoU of the map of all evidence and of the robots' own maps."""
    with open_result(path) as result:
        truth, stored = village_of(result), result.map(CENTRAL)
        of_team = counts_of(stored, truth, Region([stored.octree.spans()]))
        own = [result.evidence(robot_id) for robot_id in result.robots]
        of_robots = [counts_of(evidence, truth, Region([evidence.octree.spans()])) for evidence in own]
        errors = pose_errors(folder_of_logs(result))
    return {
        "error": errors.refined if poses == REFINED else errors.recorded,
        "corrected": errors.corrected if poses == REFINED else 0.0,
        "iou": of_team.mean_iou, "occupied": of_team.occupied_iou,
        "own": fmean(counts.mean_iou for counts in of_robots),
    }  # fmt: skip


_NUMBERS = {
    "error": "error of the poses, m",
    "iou": "mean IoU",
    "occupied": "IoU of occupied cells",
    "own": "mean IoU of own maps",
}
"""Headings of what is compared, by the beginning of its columns."""
_CLEAR = "clear contradiction, %"
_MEASURES = (
    Measure("robots corrected, %", f"corrected_{REFINED}", 0, 100.0),
    *(
        measure
        for name, heading in _NUMBERS.items()
        for measure in (
            Measure(f"{heading}, as recorded", f"{name}_{RECORDED}", 3),
            Measure("refined", f"{name}_{REFINED}", 3),
            Measure("change", f"{name}_gain", 3),
        )
    ),
    Measure(f"{_CLEAR}, as recorded", f"clear_{RECORDED}", 2, 100.0),
    Measure("refined", f"clear_{REFINED}", 2, 100.0),
)
_PANELS = {
    heading: {
        "as recorded": Measure(heading, f"{name}_{RECORDED}", None, factor),
        "refined": Measure(heading, f"{name}_{REFINED}", None, factor),
    }
    for name, heading, factor in (
        *((name, _NUMBERS[name], 1.0) for name in ("error", "iou", "occupied")),
        ("clear", _CLEAR, 100.0),
    )
}
_OF_DRIFT = Comparison(
    "drift",
    "drift",
    lambda row: f"{float(row['drift']):g} %, {float(row['drift']) / 2:g}° per 10 m",
    _MEASURES,
    title="drift of dead reckoning",
)
_OF_NOISE = Comparison(
    "noise", "noise", lambda row: f"{float(row['pose_noise']):g} m", _MEASURES, title="noise of a localisation"
)

QUESTION = Question(
    experiment,
    (_OF_DRIFT, _OF_NOISE),
    {
        "drift.png": Contrasts("drift", "drift", "drift of the position [% of the way]", _PANELS),
        "noise.png": Contrasts("noise", "pose_noise", "noise of the position [m]", _PANELS),
    },
)
