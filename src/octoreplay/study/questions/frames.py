"""Frames of simulated teams that ``align`` finds, and wrong ones that it accepts."""

from __future__ import annotations

import dataclasses
from typing import Any

from octoreplay.config.class_tables.edits import Merges
from octoreplay.config.frames_file import load_frames_file
from octoreplay.evaluate.alignments import PairOutcome, pair_outcomes
from octoreplay.evaluate.truth_frame import FRAMES_FILE
from octoreplay.replay.alignment import align_robots, stored_maps
from octoreplay.report.comparisons import Comparison, Measure, Row
from octoreplay.report.experiment_plots import Dots
from octoreplay.result import open_result
from octoreplay.simulate.settings import SimulationConfig
from octoreplay.simulate.world import village_classes
from octoreplay.study.experiments import Experiment, Plan, Question, SimulatedTeam
from octoreplay.study.questions.settings import LAST_MAPS
from octoreplay.study.sweep import Sweep

_NUM_ROBOTS = 4
_WORLD_SIZE = 32.0
"""Edge of the village [m], in which the ways of four robots cross within 40 s."""
_RATE = 2.0
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
}
"""Settings of the simulation, and merged classes, by the name of the condition."""

_USUAL = {
    "label_noise": SimulationConfig.label_noise,
    "similar_errors": False,
    "patchy_noise": 0.0,
    "kinds_per_class": 1,
}
"""Values of the settings that conditions change."""

_MIN_OVERLAP = 0.1
"""Overlap from which a pair counts as overlapping and should be found."""


def experiment(duration: float, num_villages: int) -> Experiment:
    """Four robots in own frames: noises of labels and numbers of classes, and parts of the logs, which overlap less."""
    teams = {
        f"{index}_{seed}": SimulatedTeam(
            SimulationConfig(
                num_robots=_NUM_ROBOTS, world_size=_WORLD_SIZE, rate=_RATE, own_frames=True, duration=duration,
                seed=seed, **values,
            ),
            merges,
        )
        for index, (values, merges) in enumerate(_CONDITIONS.values())
        for seed in range(num_villages)
    }  # fmt: skip
    usual = tuple(label for label in teams if label.startswith("0_"))
    lengths = ",".join(f"{duration * share:g}" for share in (1.0, 0.75, 0.5, 0.25))
    # The evidence of each robot is what counts, and no rule changes it.
    settings = {"rule": "local", "settle": 0, **LAST_MAPS}
    plan = Plan("conditions", tuple(teams), (), settings, has_truth=False, keep=True, extra_columns=_outcome)
    return Experiment(
        teams, (plan, dataclasses.replace(plan, name="lengths", teams=usual, vary=(f"duration={lengths}",)))
    )


def _outcome(team: SimulatedTeam, row: Row, sweep: Sweep) -> dict[str, Any]:
    """Condition of a team, and the shares of its pairs that ``align`` finds, refuses and accepts wrongly."""
    with open_result(sweep.result(dict(row))) as result:
        maps, T_map_own = stored_maps(result)
        alignment = align_robots(result.config, maps, T_map_own=T_map_own)
        true = load_frames_file(result.config.robots[0].logs[0].parent / FRAMES_FILE)
    pairs = pair_outcomes(alignment, true)
    overlapping = [pair for pair in pairs if pair.overlap >= _MIN_OVERLAP]
    found = [pair for pair in pairs if pair.is_accepted and pair.is_right]
    wrong = [pair for pair in pairs if pair.is_accepted and not pair.is_right]
    return {
        "condition": _condition(team), "num_pairs": len(pairs), "num_found": len(found), "num_wrong": len(wrong),
        "num_overlapping": len(overlapping), "overlap": sum(pair.overlap for pair in pairs) / len(pairs),
        "found": len(found) / len(pairs), "wrong": len(wrong) / len(pairs),
        "refused": 1.0 - (len(found) + len(wrong)) / len(pairs),
        "recall": _share_found(overlapping),
        "connected": len(alignment.teams[0]) / len(maps),
        "frame_shift": max((pair.shift for pair in found), default=float("nan")),
    }  # fmt: skip


def _condition(team: SimulatedTeam) -> str:
    """Name of a team's condition."""
    simulation = team.simulation
    return next(
        name for name, (values, merges) in _CONDITIONS.items()
        if team.merge_classes == merges and simulation == dataclasses.replace(simulation, **{**_USUAL, **values})
    )  # fmt: skip


def _share_found(pairs: list[PairOutcome]) -> float:
    """Share of the pairs that are accepted with a right pose; NaN without pairs."""
    return sum(pair.is_accepted and pair.is_right for pair in pairs) / len(pairs) if pairs else float("nan")


_MEASURES = (
    Measure("found, % of all pairs", "found", 0, 100.0),
    Measure("found, % of overlapping pairs", "recall", 0, 100.0),
    Measure("accepted wrongly, % of all pairs", "wrong", 1, 100.0),
    Measure("robots connected, %", "connected", 0, 100.0),
)
_OF_CONDITIONS = Comparison("conditions", "labels", lambda row: str(row["condition"]), _MEASURES, _DEFAULT)
_OF_LENGTHS = Comparison(
    "lengths",
    "length of the logs",
    lambda row: f"{float(row['duration']):g} s",
    (Measure("mean overlap, %", "overlap", 1, 100.0), *_MEASURES),
)

QUESTION = Question(
    experiment,
    (_OF_CONDITIONS, _OF_LENGTHS),
    {"conditions.png": Dots(_OF_CONDITIONS), "lengths.png": Dots(_OF_LENGTHS, 15.0)},
)
