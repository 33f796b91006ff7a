"""Tests of the experiments: the plans of all are valid, and a small experiment runs from beginning to end."""

from __future__ import annotations

import csv
import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from octoreplay.config.network import ScheduleEntry
from octoreplay.config.team_file import load_team_file
from octoreplay.errors import InputError
from octoreplay.simulate.settings import SimulationConfig
from octoreplay.study import experiments
from octoreplay.study.experiments import Experiment, Plan, SimulatedTeam, run_experiment
from octoreplay.study.grid import check_variations, combinations, parse_variation
from octoreplay.study.questions import QUESTIONS
from support.fixture_paths import PAIR_TEAM

pytestmark = pytest.mark.long


NUM_RUNS = {
    "rules": {"rules": 10 * 2 * 2},
    "graphs": {"graphs": 4 * 4 * 2},
    "forgetting": {"cut": 9 * 2, "halves": 9 * 2},
    "packets": {"six_robots": 16 * 2, "sixteen_robots": 16 * 2},
    "radio": {"radio": 7 * 6 * 2},
    "delay": {"delay": 3 * 4 * 2},
    "noise": {"noise": 14 * 3 * 2},
    "confidence": {
        "sensor_models": 17 * 2,
        "calibration": 5 * 2,
        "labels": 4 * 3 * 2,
        "confidences": 3 * 5 * 2,
        "confidences_prior": 5 * 2,
    },
    "steps": {"steps": 2 * 5 * 6 * 2, "evidence": 3 * 3 * 2, "bound": 4 * 8},
    "scale": {"robots": 6 * 3, "resolution": 5 * 2, "classes": 4 * 2},
    "frames": {"conditions": 15 * 2, "lengths": 4 * 2, "ages": 4 * 2},
    "drift": {"drift": 5 * 2 * 2, "noise": 3 * 2 * 2},
    "misalignment": {"shifts": 3 * 7 * 2, "turns": 3 * 5 * 2},
    "real": {"real": 9 * 3 * 3},
    "prediction": {"prediction": 17 * 9},
}


@pytest.mark.parametrize("name", QUESTIONS)
def test_every_experiment_consists_of_valid_distinct_runs(name: str, tmp_path: Path) -> None:
    experiment = QUESTIONS[name].experiment(*_inputs(name, tmp_path))
    base = load_team_file(PAIR_TEAM)
    counts = {}
    for plan in experiment.plans:
        assert set(plan.teams) <= set(experiment.teams)
        variations = [parse_variation(text) for text in plan.vary]
        check_variations(variations, plan.settings, None)
        runs = list(combinations(dict.fromkeys(plan.teams, base), variations, plan.settings, None))
        counts[plan.name] = len(runs)
    assert counts == NUM_RUNS[name]
    # All runs of the last plan differ.
    assert len({str(run.config) + run.team for run in runs}) == len(runs)


def _inputs(name: str, folder: Path) -> tuple[Any, ...]:
    """Parameters of an experiment: a recording, or the length of logs and the number of villages."""
    if name not in ("real", "prediction"):
        return 30.0, 2
    for index in range(64):
        (folder / f"frame-{index:06d}.depth.png").touch()
        np.savetxt(folder / f"frame-{index:06d}.pose.txt", np.eye(4))
    return ([folder],)


def small(**plan) -> Experiment:
    """Two teams of two robots over two seconds, in two villages; the second team merges classes."""
    pytest.importorskip("open3d", exc_type=ImportError)
    teams = {
        f"village_{seed}": SimulatedTeam(
            SimulationConfig(num_robots=2, duration=2.0, seed=seed, rate=2.0, image=(48, 36), world_size=20.0),
            (("plant", ("grass", "foliage")),) if seed else (),
        )
        for seed in (0, 1)
    }
    return Experiment(teams, (Plan("first", tuple(teams), **plan),))


def test_a_small_experiment_runs_from_beginning_to_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    # A relative folder, as the default of the command is.
    folder = Path("octoreplay-small")
    stages: list[str] = []
    experiment = small(
        vary=("rule=local,bayes",), settings={"settle": 0}, keep=True,
        extra_columns=lambda team, row, sweep: {
            "seed_of_team": team.simulation.seed, "is_kept": sweep.result(row).is_file(),
        },
    )  # fmt: skip
    rows = run_experiment(experiment, folder, progress=lambda stage, _: stages.append(stage))["first"]
    assert [(row["team"], row["rule"]) for row in rows] == [
        ("village_0", "local"), ("village_0", "bayes"), ("village_1", "local"), ("village_1", "bayes"),
    ]  # fmt: skip
    assert [row["seed_of_team"] for row in rows] == [row["village"] for row in rows] == [0, 0, 1, 1]
    assert all(row["is_kept"] for row in rows)
    assert all(0 < row["central_mean_iou"] <= 1 for row in rows)
    # Rule local exchanges nothing.
    assert [row["sent_bytes_per_second"] > 0 for row in rows] == [False, True, False, True]
    assert "writing the logs of team 2 of 2" in stages
    assert stages[-1] == "first: run 4 of 4"
    (merged_file,) = (folder / "teams").glob("seed_1_*/village_1.yaml")
    merged = load_team_file(merged_file)
    assert merged.classes is not None
    assert merged.classes.names[0] == "plant"
    assert merged.classes.num_classes == 7

    stored = list(csv.DictReader((folder / "first.csv").read_text(encoding="utf-8").splitlines()))
    assert [{name: str(value) for name, value in row.items()} for row in rows] == stored
    again = run_experiment(experiment, folder)["first"]
    assert str(again) == str(rows)


def test_teams_of_equal_simulations_share_their_logs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folders: list[Path] = []
    monkeypatch.setattr(experiments, "simulated_team", lambda folder, *_: folders.append(folder))
    first, second = SimulationConfig(seed=1), SimulationConfig(seed=1, rate=2.0)
    teams = {"a": SimulatedTeam(first), "b": SimulatedTeam(second), "c": SimulatedTeam(SimulationConfig(seed=1))}
    files = experiments._team_files(Experiment(teams, ()), tmp_path, lambda *_: None)
    assert len(set(folders)) == len(folders) == 2
    assert all(folder.parent == tmp_path and folder.name.startswith("seed_1_") for folder in folders)
    assert files == {"a": folders[0] / "team.yaml", "b": folders[1] / "team.yaml", "c": folders[0] / "team.yaml"}


def test_a_team_file_gets_the_schedule_and_the_period(tmp_path: Path) -> None:
    experiment = small()
    cut = ScheduleEntry(start=1.0, groups=(("husky_1",), ("husky_2",)))
    team = dataclasses.replace(experiment.teams["village_0"], schedule=(cut,), publish_period=2.0)
    files = experiments._team_files(Experiment({"cut": team}, ()), tmp_path, lambda *_: None)
    config = load_team_file(files["cut"])
    assert config.network.schedule == (cut,)
    assert {robot.publish_period for robot in config.robots} == {2.0}
    assert load_team_file(files["cut"].parent / "team.yaml").network.schedule == ()


def test_a_team_without_a_team_file_is_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        SimulatedTeam, "team_file", lambda self, label, folder: None if self.seed else folder / "team.yaml"
    )
    rows = run_experiment(small(vary=("rule=local,bayes",), settings={"settle": 0}), tmp_path)["first"]
    assert [row["team"] for row in rows] == ["village_0"] * 2


def test_a_failed_run_fails_the_experiment(tmp_path: Path) -> None:
    with pytest.raises(
        InputError, match=r"first: 2 of 4 runs failed, the first with: .*epsilon.*; the same command repeats"
    ):
        run_experiment(small(vary=("epsilon=0.5,4",), settings={"topology": "range", "radio_range": 1e3}), tmp_path)
    assert not (tmp_path / "first.csv").exists()
