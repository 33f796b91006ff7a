"""Question on frames: the conditions of its teams, and the outcomes of a small run."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from octoreplay.study.experiments import run_experiment
from octoreplay.study.questions import frames


def test_every_team_has_its_condition() -> None:
    teams = frames.experiment(10.0, 2).teams
    names = [frames._condition(team) for team in teams.values()]
    assert names == [name for name in frames._CONDITIONS for _ in range(2)]
    # Merged classes need no simulation of their own.
    assert len({team.folder_name for team in teams.values()}) == 2 * (len(frames._CONDITIONS) - 2)


@pytest.mark.long
def test_the_pairs_of_a_team_are_found_refused_or_wrong(tmp_path: Path) -> None:
    pytest.importorskip("open3d", exc_type=ImportError)
    question = frames.experiment(12.0, 1)
    plan = dataclasses.replace(question.plans[0], teams=("0_0",))
    (row,) = run_experiment(
        dataclasses.replace(question, teams={"0_0": question.teams["0_0"]}, plans=(plan,)), tmp_path
    )["conditions"]
    assert row["condition"] == "10 % of pixels wrong"
    assert row["num_pairs"] == 6
    assert 1 <= row["num_overlapping"] < 6
    assert row["found"] == pytest.approx(row["num_found"] / 6)
    assert row["found"] + row["refused"] + row["wrong"] == pytest.approx(1.0)
    # Two robots begin near each other.
    assert row["num_found"] >= 1
    assert row["frame_shift"] < 1.0
    assert row["connected"] == 0.5
    assert 0.0 < row["overlap"] < 0.5


@pytest.mark.long
def test_maps_of_now_are_aligned_with_old_ones_of_the_others(tmp_path: Path) -> None:
    pytest.importorskip("open3d", exc_type=ImportError)
    question = frames.experiment(12.0, 1)
    plan = dataclasses.replace(
        next(plan for plan in question.plans if plan.name == "ages"), teams=("0_0",), vary=("duration=12,6",)
    )
    now, old = run_experiment(
        dataclasses.replace(question, teams={"0_0": question.teams["0_0"]}, plans=(plan,)), tmp_path
    )["ages"]
    assert (now["age"], old["age"]) == (0.0, 6.0)
    # Each map is aligned with those of the three other robots.
    assert now["num_pairs"] == old["num_pairs"] == 12
    assert old["overlap"] != now["overlap"]
    # Without age each pair is aligned twice.
    assert now["num_overlapping"] % 2 == 0
    assert now["num_found"] >= 2
