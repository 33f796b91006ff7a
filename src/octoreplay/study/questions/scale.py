"""Run times, memory and bytes for numbers of robots, cells and classes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from octoreplay.report.comparisons import KILOBYTES, Comparison, Measure, Row
from octoreplay.report.experiment_plots import Curves
from octoreplay.simulate.settings import SimulationConfig
from octoreplay.simulate.world import village_classes
from octoreplay.study.experiments import Experiment, Plan, Question, SimulatedTeam
from octoreplay.study.questions.settings import DURING, LAST_MAPS, rule_name

_NUM_ROBOTS = (2, 4, 8, 16, 32, 64)
_RESOLUTIONS = (0.1, 0.15, 0.2, 0.3, 0.5)


def experiment(duration: float, num_villages: int) -> Experiment:
    """Run times, memory and bytes for numbers of robots, cells and classes, in one village."""
    del num_villages  # run times hardly depend on the village
    robots = {
        f"robots_{count:02d}": SimulatedTeam(SimulationConfig(num_robots=count, duration=duration))
        for count in _NUM_ROBOTS
    }
    six = {"six": SimulatedTeam(SimulationConfig(duration=duration))}
    classes = {
        "classes_04": SimulatedTeam(
            SimulationConfig(duration=duration),
            (("ground", ("grass", "dirt_road")), ("house", ("building", "roof")), ("tree", ("trunk", "foliage")),
             ("obstacle", ("fence", "car"))),
        ),
        "classes_08": SimulatedTeam(SimulationConfig(duration=duration)),
        "classes_16": SimulatedTeam(SimulationConfig(duration=duration, kinds_per_class=2)),
        "classes_32": SimulatedTeam(SimulationConfig(duration=duration, kinds_per_class=4)),
    }  # fmt: skip
    resolutions = ",".join(f"{resolution:g}" for resolution in _RESOLUTIONS)
    return Experiment(
        {**robots, **six, **classes},
        (
            _timed("robots", robots, ("topology+resolution=complete+0.3,nearest+0.3,nearest+0.2",), {"num_nearest": 3}),
            _timed("resolution", six, (f"resolution={resolutions}", "rule=gradient,bayes"), {}),
            _timed("classes", classes, ("rule=gradient,bayes",), {}),
        ),
    )


def _timed(
    name: str, teams: Mapping[str, SimulatedTeam], vary: tuple[str, ...], settings: Mapping[str, object]
) -> Plan:
    """Plan that measures time: two threads, one run at once, without settling and evaluation."""
    return Plan(
        name,
        tuple(teams),
        vary,
        {**settings, "settle": 0, **LAST_MAPS},
        has_truth=False,
        num_threads=2,
        extra_columns=_sizes,
    )


def _sizes(team: SimulatedTeam, *_: object) -> dict[str, Any]:
    """Numbers of robots and classes of a team."""
    simulation = team.simulation
    return {
        "num_robots": simulation.num_robots,
        "num_classes": len(team.merge_classes) or len(village_classes(simulation.kinds_per_class).classes),
    }


def _graph(row: Row) -> str:
    """Name of a graph and resolution."""
    return f"{row['topology']}, {row['resolution']} m"


_MEASURES = (
    Measure("real-time factor", "realtime_factor", None, is_ratio=True),
    Measure("peak memory, MB", "peak_rss_bytes", None, 1e-6, is_ratio=True),
    Measure("largest memory of a robot, MB", "memory_bytes", None, 1e-6, is_ratio=True),
    KILOBYTES,
    Measure("leaves per map", "num_leaves", None, is_ratio=True),
)

QUESTION = Question(
    experiment,
    (
        Comparison(
            "robots",
            "robots, graph, cells",
            lambda row: f"{row['num_robots']}, {_graph(row)}",
            (*_MEASURES, DURING),
            title="robots",
        ),
        Comparison(
            "resolution", "cells, rule", lambda row: f"{row['resolution']} m, {row['rule']}", _MEASURES, title="cells"
        ),
        Comparison(
            "classes", "classes, rule", lambda row: f"{row['num_classes']}, {row['rule']}", _MEASURES, title="classes"
        ),
    ),
    {
        "robots.png": Curves("robots", "num_robots", "robots", _MEASURES[:4], _graph, is_log=True),
        "resolution.png": Curves("resolution", "resolution", "cells [m]", _MEASURES[:4], rule_name, is_log=True),
        "classes.png": Curves("classes", "num_classes", "classes", _MEASURES[:4], rule_name, is_log=True),
    },
)
