"""Frames of simulated teams that ``align`` finds, and wrong ones that it accepts."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any

from octoreplay.config.class_tables.edits import Merges
from octoreplay.config.frames_file import load_frames_file
from octoreplay.config.subteam import subteam
from octoreplay.evaluate.alignments import PairOutcome, pair_outcomes
from octoreplay.evaluate.truth_frame import FRAMES_FILE
from octoreplay.replay.alignment import align_robots, stored_maps
from octoreplay.report.comparisons import Comparison, Measure, Row
from octoreplay.report.experiment_plots import Dots
from octoreplay.result import Result, open_result
from octoreplay.simulate.settings import SimulationConfig
from octoreplay.simulate.world import village_classes
from octoreplay.study.experiments import Experiment, Plan, Question, SimulatedTeam
from octoreplay.study.questions.settings import LAST_MAPS, folder_of_logs, small_village
from octoreplay.study.sweep import Sweep

_CLASSES = village_classes().names
_GROUND, _HOUSE, _TREE, _OBSTACLE = (_CLASSES[first : first + 2] for first in range(0, 8, 2))

_DEFAULT = "10 % of pixels wrong"
_CONDITIONS: dict[str, tuple[dict[str, Any], Merges]] = {
    _DEFAULT: ({}, ()),
    "no noise of labels": ({"label_noise": 0.0}, ()),
    "40 % of pixels wrong": ({"label_noise": 0.4}, ()),
    "40 % of pixels confused": ({"label_noise": 0.4, "similar_errors": True}, ()),
    "10 % of places wrong": ({"patchy_noise": 0.1}, ()),
    "30 % of places wrong": ({"patchy_noise": 0.3}, ()),
    "32 classes": ({"kinds_per_class": 4}, ()),
    "4 classes": ({}, (("ground", _GROUND), ("house", _HOUSE), ("tree", _TREE), ("obstacle", _OBSTACLE))),
    "1 class": ({}, (("surface", _CLASSES),)),
    **{f"{noise:g} times the noise of depths": ({"depth_noise": noise}, ()) for noise in (2.0, 4.0)},
    **{f"poses off by {noise:g} m": ({"pose_noise": noise}, ()) for noise in (0.1, 0.4)},
    **{f"drift of {drift:g} %": ({"odometry_drift": (drift, drift / 2.0)}, ()) for drift in (1.0, 4.0)},
}
"""Settings of the simulation, and merged classes, by the name of the condition."""

_USUAL = {
    "label_noise": SimulationConfig.label_noise,
    "similar_errors": False,
    "patchy_noise": 0.0,
    "kinds_per_class": 1,
    "depth_noise": SimulationConfig.depth_noise,
    "pose_noise": SimulationConfig.pose_noise,
    "odometry_drift": SimulationConfig.odometry_drift,
}
"""Values of the settings that conditions change."""

_MIN_OVERLAP = 0.1
"""Overlap from which a pair counts as overlapping and should be found."""


def experiment(duration: float, num_villages: int) -> Experiment:
    """Four robots in own frames: noises, numbers of classes, parts of the logs, and old maps of other robots."""
    teams = {
        f"{index}_{seed}": SimulatedTeam(small_village(duration, seed, **values), merges)
        for index, (values, merges) in enumerate(_CONDITIONS.values())
        for seed in range(num_villages)
    }
    usual = tuple(label for label in teams if label.startswith("0_"))
    # The evidence of each robot is what counts, and no rule changes it.
    settings = {"rule": "local", "settle": 0, **LAST_MAPS}
    plan = Plan("conditions", tuple(teams), (), settings, has_truth=False, keep=True, extra_columns=_outcome)
    parts = dataclasses.replace(plan, teams=usual, vary=(_durations(duration, (1.0, 0.75, 0.5, 0.25)),), name="lengths")
    aged = dataclasses.replace(
        parts, vary=(_durations(duration, (1.0, 0.875, 0.75, 0.5)),), name="ages", extra_columns=_outcome_with_age
    )
    return Experiment(teams, (plan, parts, aged))


def _durations(duration: float, shares: Sequence[float]) -> str:
    """Variation over parts of the logs, the whole first."""
    return f"duration={','.join(f'{duration * share:g}' for share in shares)}"


def _outcome(team: SimulatedTeam, row: Row, sweep: Sweep) -> dict[str, Any]:
    """Condition of a team, and the outcomes of its alignment."""
    with open_result(sweep.result(dict(row))) as result:
        maps, T_map_own = stored_maps(result)
        alignment = align_robots(result.config, maps, T_map_own=T_map_own)
        pairs = pair_outcomes(alignment, _true_frames(result))
    return {
        "condition": _condition(team), **_shares(pairs), "connected": len(alignment.teams[0]) / len(maps),
        "frame_shift": max((pair.shift for pair in pairs if _is_found(pair)), default=float("nan")),
    }  # fmt: skip


def _outcome_with_age(team: SimulatedTeam, row: Row, sweep: Sweep) -> dict[str, Any]:
    """Age of a run's maps, and the outcomes of each with the last map of every other robot.

    The map of a robot some time ago is that of a run whose logs end so much earlier.
    """
    whole = {**row, "duration": f"{team.simulation.duration:g}"}
    with open_result(sweep.result(whole)) as result, open_result(sweep.result(dict(row))) as earlier:
        (maps, T_map_own), (aged, _) = stored_maps(result), stored_maps(earlier)
        robots, true = result.config.robots, _true_frames(result)
        pairs: list[PairOutcome] = []
        for own, other in itertools.permutations(range(len(robots)), 2):
            alignment = align_robots(
                subteam(result.config, [robots[own], robots[other]]),
                [maps[own], aged[other]],
                T_map_own=[T_map_own[own], T_map_own[other]],
            )
            pairs += pair_outcomes(alignment, true)
    return {"age": team.simulation.duration - float(row["duration"]), **_shares(pairs)}


def _true_frames(result: Result) -> dict[str, tuple[float, ...]]:
    """True T_team_map of each robot, from the file beside the logs."""
    return load_frames_file(folder_of_logs(result) / FRAMES_FILE)


def _shares(pairs: Sequence[PairOutcome]) -> dict[str, float]:
    """Numbers of pairs, and the shares that are found, refused and accepted wrongly."""
    overlapping = [pair for pair in pairs if pair.overlap >= _MIN_OVERLAP]
    num_found, num_wrong = sum(map(_is_found, pairs)), sum(pair.is_accepted and not pair.is_right for pair in pairs)
    return {
        "num_pairs": len(pairs), "num_found": num_found, "num_wrong": num_wrong, "num_overlapping": len(overlapping),
        "overlap": sum(pair.overlap for pair in pairs) / len(pairs),
        "found": num_found / len(pairs), "wrong": num_wrong / len(pairs),
        "refused": 1.0 - (num_found + num_wrong) / len(pairs),
        "recall": sum(map(_is_found, overlapping)) / len(overlapping) if overlapping else float("nan"),
    }  # fmt: skip


def _is_found(pair: PairOutcome) -> bool:
    """True where a pair is accepted with a right pose."""
    return pair.is_accepted and pair.is_right


def _condition(team: SimulatedTeam) -> str:
    """Name of a team's condition."""
    simulation = team.simulation
    return next(
        name for name, (values, merges) in _CONDITIONS.items()
        if team.merge_classes == merges and simulation == dataclasses.replace(simulation, **{**_USUAL, **values})
    )  # fmt: skip


_MEASURES = (
    Measure("found, % of all pairs", "found", 0, 100.0),
    Measure("found, % of overlapping pairs", "recall", 0, 100.0),
    Measure("accepted wrongly, % of all pairs", "wrong", 1, 100.0),
    Measure("robots connected, %", "connected", 0, 100.0),
)
_OF_CONDITIONS = Comparison(
    "conditions", "condition", lambda row: str(row["condition"]), _MEASURES, _DEFAULT, title="noise, classes and poses"
)
_OVERLAP = Measure("mean overlap, %", "overlap", 1, 100.0)
_OF_LENGTHS = Comparison(
    "lengths",
    "length of the logs",
    lambda row: f"{float(row['duration']):g} s",
    (_OVERLAP, *_MEASURES),
    title="length of the logs",
)
_OF_AGES = Comparison(
    "ages",
    "age of one map",
    lambda row: f"{float(row['age']):g} s",
    (_OVERLAP, *_MEASURES[:3]),
    "0 s",
    title="age of one map",
)

QUESTION = Question(
    experiment,
    (_OF_CONDITIONS, _OF_LENGTHS, _OF_AGES),
    {
        "conditions.png": Dots(_OF_CONDITIONS),
        "lengths.png": Dots(_OF_LENGTHS, 15.0),
        "ages.png": Dots(_OF_AGES, 13.0),
    },
)
