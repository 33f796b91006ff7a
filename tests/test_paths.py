"""Paths as text and as objects in the public API: each function does the same with both."""

from __future__ import annotations

import functools
import inspect
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

import octoreplay
from octoreplay.errors import OctoreplayError
from support.fixture_paths import FIXTURES, PAIR, PAIR_TEAM

RESULT = FIXTURES / "result_3.mcap"


@dataclass(frozen=True)
class Location:
    """A path object that is no Path and has no attribute of one."""

    text: str

    def __fspath__(self) -> str:
        return self.text


FORMS: tuple[Callable[[Path], Any], ...] = (Path, str, lambda path: Location(str(path)))

Given = Callable[[str | Path], Any]
"""Function that returns a path of the test's folder in one of the forms."""

CASES: dict[tuple[str, ...], Callable[[Given], Any]] = {
    ("load_team_file", "path"): lambda at: octoreplay.load_team_file(at(PAIR_TEAM)),
    ("load_frames_file", "path"): lambda at: octoreplay.load_frames_file(at("frames.yaml")),
    ("load_paths_file", "path"): lambda at: octoreplay.load_paths_file(at("paths.yaml")),
    ("discover", "logs"): lambda at: octoreplay.discover([at(PAIR / "husky_1.mcap")]),
    ("open_log", "path"): lambda at: list(_closed(octoreplay.open_log(at(PAIR / "husky_1.mcap"))).topics),
    ("replay_team", "output"): lambda at: octoreplay.replay_team(_resolved_pair(), at("missing/out.mcap")),
    ("replay_tiles", "output"): lambda at: octoreplay.replay_tiles(_resolved_pair(), at("missing/out.mcap"), 50.0),
    ("open_result", "path"): lambda at: _closed(octoreplay.open_result(at(RESULT))).robots,
    ("export_map", "result_path", "output"): lambda at: octoreplay.export_map(at(RESULT), at("map.ply"), "unknown"),
    ("evaluate_result", "path", "truth", "against"): lambda at: octoreplay.evaluate_result(
        at(RESULT), truth=at("world.npz"), against=at(RESULT), over_time=False
    ),
    ("check_result", "path", "truth"): lambda at: octoreplay.check_result(
        at(RESULT), {"min_mean_iou": 0.1}, truth=at("world.npz")
    ),
    ("compare_results", "a", "b"): lambda at: octoreplay.compare_results(at(RESULT), at(RESULT)),
    ("run_sweep", "teams", "output", "truth"): lambda at: octoreplay.run_sweep(
        at(PAIR_TEAM), ["topology=ring"], at("sweep"), truth=at("world.npz")
    ),
    ("simulate_team", "folder"): lambda at: octoreplay.simulate_team(at(RESULT), octoreplay.SimulationConfig()),
    ("import_rgbd", "folder", "output", "times", "labels"): lambda at: octoreplay.import_rgbd(
        at("empty"), at("log.mcap"), times=at("times.txt"), labels=at("labels")
    ),
    ("import_clouds", "folder", "output", "times", "poses", "labels"): lambda at: octoreplay.import_clouds(
        at("empty"), at("log.mcap"), times=at("times.txt"), poses=at("poses.txt"), labels=at("labels")
    ),
    ("RobotConfig",): lambda at: octoreplay.RobotConfig(
        "husky", at("a.mcap"), pose_file=at("a.tum"), pose_times=at("a.txt")
    ),
}
"""A call of every public function with a path, by its name and its parameters that are paths."""


@functools.cache
def _resolved_pair() -> octoreplay.RunConfig:
    """The team of two robots, with its topics."""
    return octoreplay.resolve(octoreplay.load_team_file(PAIR_TEAM))


def _closed(opened: Any) -> Any:
    """A reader after its file is closed."""
    opened.close()
    return opened


def outcome(call: Callable[[Given], Any], given: Given) -> str:
    """The value of a call, or the error with which it ends."""
    try:
        return repr(call(given))
    except OctoreplayError as error:
        return f"{type(error).__name__}: {error}"


@pytest.mark.parametrize("case", CASES, ids=lambda case: case[0])
def test_a_path_may_be_text_or_an_object(case: tuple[str, ...], tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    outcomes = {outcome(CASES[case], lambda name, form=form: form(tmp_path / name)) for form in FORMS}
    assert len(outcomes) == 1


def test_every_parameter_that_is_a_path_is_tested() -> None:
    found = set()
    for name in octoreplay.__all__:
        value = getattr(octoreplay, name)
        if inspect.isfunction(value):
            parameters = inspect.signature(value).parameters.values()
            paths = tuple(item.name for item in parameters if "Path" in str(item.annotation))
            # `Path` alone would refuse text.
            assert all("FilePath" in str(item.annotation) for item in parameters if item.name in paths)
            found |= {(name, *paths)} if paths else set()
    assert found == {case for case in CASES if len(case) > 1}


def test_one_log_of_a_robot_may_be_given_without_a_tuple() -> None:
    assert octoreplay.RobotConfig("husky", "a.mcap").logs == (Path("a.mcap"),)
    assert os.fspath(octoreplay.RobotConfig("husky", ["a.mcap"]).files[0]) == "a.mcap"
