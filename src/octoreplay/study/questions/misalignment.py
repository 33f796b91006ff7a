"""Errors of the robots' frames from which on a robot's map is worse with exchange than without."""

from __future__ import annotations

from pathlib import Path
from statistics import fmean
from typing import Any

from octoreplay.evaluate.morton_intervals import Region
from octoreplay.mapping.contradiction import CLEAR_LIMIT
from octoreplay.records import CENTRAL
from octoreplay.report.comparisons import Comparison, Label, Measure, Row
from octoreplay.report.experiment_plots import Contrasts
from octoreplay.result import open_result
from octoreplay.simulate.settings import SimulationConfig
from octoreplay.study.experiments import Experiment, Plan, Question
from octoreplay.study.misaligned_teams import CASES, MisalignedTeam
from octoreplay.study.questions.settings import LAST_MAPS, counts_of, small_village, village_of
from octoreplay.study.sweep import Sweep

_SHIFTS = (0.0, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0)
"""Shifts of a wrong frame [m]."""
_ANGLES = (0.0, 1.0, 2.0, 5.0, 10.0)
"""Rotations of a wrong frame [degree]."""


def experiment(duration: float, num_villages: int) -> Experiment:
    """Four robots with wrong frames: one of them, or all but one, shifted or turned."""
    simulations = [small_village(duration, seed) for seed in range(num_villages)]
    shifts = {f"shift_{shift:g}": (shift, 0.0) for shift in _SHIFTS}
    turns = {f"turn_{angle:g}": (0.0, angle) for angle in _ANGLES}
    plans = {"shifts": _teams(simulations, shifts), "turns": _teams(simulations, turns)}
    return Experiment(
        {label: team for teams in plans.values() for label, team in teams.items()},
        tuple(
            Plan(name, tuple(teams), (), LAST_MAPS, has_truth=False, keep=True, extra_columns=_gains)
            for name, teams in plans.items()
        ),
    )


def _teams(simulations: list[SimulationConfig], errors: dict[str, tuple[float, float]]) -> dict[str, MisalignedTeam]:
    """Teams by label for every case and error."""
    return {
        f"{name}_{index}_{simulation.seed}": MisalignedTeam(simulation, case, shift, angle)
        for index, case in enumerate(CASES)
        for name, (shift, angle) in errors.items()
        for simulation in simulations
    }


def _gains(team: MisalignedTeam, row: Row, sweep: Sweep) -> dict[str, Any]:
    """Mean IoU of the robots' maps with and without exchange, over two regions, and the difference.

    The regions are what the team's evidence covers with right frames, and what the robot's own evidence covers.
    """
    kind, _, *others = Path(row["team"]).name.split("_")
    right = {**row, "team": str(Path(row["team"]).with_name("_".join((kind, "0", *others))))}
    with open_result(sweep.result(right)) as result:
        whole = Region([result.map(CENTRAL).octree.spans()])
    with open_result(sweep.result(dict(row))) as result:
        truth = village_of(result)
        found: dict[str, list[float]] = {}
        for robot_id in team.judged:
            alone, together = result.evidence(robot_id), result.map(robot_id)
            for name, region in (("whole", whole), ("own", Region([alone.octree.spans()]))):
                without, exchanged = (counts_of(stored, truth, region).mean_iou for stored in (alone, together))
                found.setdefault(f"{name}_alone", []).append(without)
                found.setdefault(f"{name}_together", []).append(exchanged)
                found.setdefault(f"{name}_gain", []).append(exchanged - without)
    means = {name: fmean(values) for name, values in found.items()}
    return {"frames": team.case, "shift": team.shift, "angle": team.angle, **means}


_ALONE, _TOGETHER = "without exchange", "with exchange"
_REGIONS = {"whole": "mean IoU of the team's cells", "own": "mean IoU of the robot's own cells"}
_CLEAR = Measure("clear contradiction, %", "clear_contradiction", 2, 100.0)
_MEASURES = tuple(
    measure
    for name, heading in _REGIONS.items()
    for measure in (
        Measure(f"{heading}, {_ALONE}", f"{name}_alone", 3),
        Measure(_TOGETHER, f"{name}_together", 3),
        Measure("gain", f"{name}_gain", 3),
    )
)
_PANELS = {
    **{
        heading: {_ALONE: Measure("", f"{name}_alone"), _TOGETHER: Measure("", f"{name}_together")}
        for name, heading in _REGIONS.items()
    },
    f"{_CLEAR.heading}, and its limit": {"largest of a pair": _CLEAR},
}


def _comparison(plan: str, title: str, name: Label) -> Comparison:
    """Table of one kind of error for each case."""
    return Comparison(plan, "error of a frame", name, (*_MEASURES, _CLEAR), section="frames", title=title)


def _figure(plan: str, x: str, x_label: str) -> Contrasts:
    """Figure of one kind of error."""
    limits = {f"{_CLEAR.heading}, and its limit": 100.0 * CLEAR_LIMIT}
    return Contrasts(plan, x, x_label, _PANELS, "frames", limits, is_log=True)


QUESTION = Question(
    experiment,
    (
        _comparison("shifts", "shift", lambda row: f"{float(row['shift']):g} m"),
        _comparison("turns", "rotation", lambda row: f"{float(row['angle']):g}°"),
    ),
    {
        "shifts.png": _figure("shifts", "shift", "shift of a wrong frame [m]"),
        "turns.png": _figure("turns", "angle", "rotation of a wrong frame [degrees]"),
    },
)
