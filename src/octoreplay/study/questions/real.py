"""Agreement, bytes and contradiction on real recordings, before and after ``align``."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from octoreplay.evaluate.repairs import erased_cells
from octoreplay.report.comparisons import KILOBYTES, Comparison, Measure, Row
from octoreplay.report.experiment_plots import Dots
from octoreplay.result import open_result
from octoreplay.study.experiments import Experiment, Plan, Question
from octoreplay.study.questions.settings import DURING, LAST_MAPS, SETTLED, rule_name
from octoreplay.study.real_teams import RealTeam, teams_of
from octoreplay.study.sweep import Sweep
from octoreplay.study.team_frames import FRAMES, RIGHT, frame_errors


def experiment(data: Sequence[Path]) -> Experiment:
    """Three rules on each team of the data: with right frames, with one of each robot's own, and aligned."""
    teams = teams_of(data, FRAMES)
    return Experiment(
        teams,
        (
            Plan(
                "real", tuple(teams), ("rule=bayes,flood,gradient",), LAST_MAPS, has_truth=False, keep=True,
                extra_columns=_changes,
            ),
        ),
    )  # fmt: skip


def _changes(team: RealTeam, row: Row, sweep: Sweep) -> dict[str, Any]:
    """Frames of a run, their errors, and the share of the robots' own occupied cells that the exchange made free."""
    with open_result(sweep.result(dict(row))) as result:
        robots = result.config.robots
        counts = [erased_cells(result.evidence(robot.robot_id), result.map(robot.robot_id)) for robot in robots]
        shift, angle = frame_errors(team.right_config(result.config), result.config)
    num_occupied, num_erased = (sum(count) for count in zip(*counts, strict=True))
    return {
        "frames": team.frames, "num_recordings": team.num_robots, "num_robots": len(robots),
        "frame_shift": shift, "frame_angle": angle,
        "erased": num_erased / num_occupied if num_occupied else math.nan,
    }  # fmt: skip


def _frames(row: Row) -> str:
    """Name of a run's frames; teams that lack a robot are not compared with whole ones."""
    is_whole = int(row["num_robots"]) == int(row["num_recordings"])
    return str(row["frames"]) if is_whole else f"{row['frames']} in part"


_CLEAR = Measure("clear contradiction, %", "clear_contradiction", 2, 100.0)
_ERASED = Measure("own occupied made free, %", "erased", 2, 100.0)
_CELLS = Measure("known cells, thousands", "num_known_cells", None, 1e-3, is_ratio=True)
_OF_FRAMES = Comparison(
    "real",
    "frames",
    _frames,
    (
        Measure("contradiction, %", "contradiction", 1, 100.0),
        _CLEAR,
        Measure("different labels during the logs, %", "label_disagreement_mean", 2, 100.0),
        DURING,
        SETTLED,
        _ERASED,
        _CELLS,
        KILOBYTES,
    ),
    RIGHT,
    "rule",
    "team",
    title="frames",
)
_OF_RULES = Comparison(
    "real", "rule", rule_name, (DURING, SETTLED, _ERASED, KILOBYTES), "bayes", "frames", "team", title="rules"
)
_DRAWN = dataclasses.replace(_OF_FRAMES, measures=(_CLEAR, DURING, _ERASED, KILOBYTES))

QUESTION = Question(experiment, (_OF_FRAMES, _OF_RULES), {"real.png": Dots(_DRAWN)})
