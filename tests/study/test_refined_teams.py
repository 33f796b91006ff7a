"""Teams with wrong poses before and after the repair of drift, and an experiment on a small team."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import pytest

from octoreplay.config.team_file import load_team_file
from octoreplay.registration.drift import DriftModel
from octoreplay.replay.refinement import RefinementConfig
from octoreplay.report.comparisons import tables_of
from octoreplay.simulate.settings import SimulationConfig
from octoreplay.study.experiments import run_experiment
from octoreplay.study.questions import drift
from octoreplay.study.refined_teams import RECORDED, REFINED, PoseErrors, RefinedTeam, pose_errors

SIMULATION = SimulationConfig(
    num_robots=2, duration=40.0, rate=2.5, image=(96, 72), seed=7, world_size=20.0, label_noise=0.0,
    odometry_drift=(2.0, 1.5),
)  # fmt: skip


def test_recorded_and_refined_teams_share_a_folder() -> None:
    recorded, refined = RefinedTeam(SIMULATION, RECORDED), RefinedTeam(SIMULATION, REFINED)
    assert recorded.folder_name == refined.folder_name
    other = dataclasses.replace(SIMULATION, odometry_drift=(4.0, 2.0))
    assert RefinedTeam(other, RECORDED).folder_name != recorded.folder_name
    assert recorded.seed == 7
    assert recorded.settings.drift == DriftModel(2.0, 1.5)
    noisy = dataclasses.replace(SIMULATION, odometry_drift=(0.0, 0.0), pose_noise=0.1)
    assert RefinedTeam(noisy, REFINED).settings == RefinementConfig()
    assert [team.team_file("a", Path("b")) for team in (recorded, refined)] == [
        Path("b/team.yaml"),
        Path("b/refined.yaml"),
    ]


def test_the_stored_errors_are_read(tmp_path: Path) -> None:
    (tmp_path / "errors.json").write_text(json.dumps({"recorded": 0.5, "refined": 0.2, "corrected": 0.75}))
    assert pose_errors(tmp_path) == PoseErrors(0.5, 0.2, 0.75)


@pytest.mark.long
def test_the_repair_of_a_small_team_lowers_the_error_and_raises_the_iou(tmp_path: Path) -> None:
    pytest.importorskip("open3d", exc_type=ImportError)
    question = drift.experiment(40.0, 1)
    teams = {f"drift_2_{poses}_0": RefinedTeam(SIMULATION, poses) for poses in (RECORDED, REFINED)}
    plan = dataclasses.replace(question.plans[0], teams=tuple(teams))
    found = run_experiment(dataclasses.replace(question, teams=teams, plans=(plan,)), tmp_path)
    recorded, refined = found["drift"]
    (folder,) = (tmp_path / "teams").iterdir()
    errors = pose_errors(folder)
    assert errors.corrected > 0.0
    assert recorded["error_recorded"] == pytest.approx(errors.recorded, rel=1e-6)
    assert refined["error_refined"] == pytest.approx(errors.refined, rel=1e-6)
    assert refined["corrected_refined"] == errors.corrected
    assert recorded["corrected_recorded"] == 0.0
    for name in ("error", "iou", "occupied", "own"):
        assert refined[f"{name}_gain"] == pytest.approx(
            refined[f"{name}_refined"] - recorded[f"{name}_recorded"], abs=1e-6
        )
    assert refined["error_gain"] < 0.0 < refined["iou_gain"]
    assert {row["drift"] for row in (recorded, refined)} == {2.0}
    # One line of the table has both kinds of poses.
    (table,) = tables_of(drift.QUESTION.comparisons[0], found)
    assert [line[0] for line in table.lines] == ["2 %, 1° per 10 m"]
    assert "-" not in table.lines[0]
    team = load_team_file(folder / "refined.yaml")
    assert {robot.pose_file for robot in team.robots if robot.pose_file is not None} <= {
        folder / "refined-poses" / f"{robot_id}.tum" for robot_id in SIMULATION.robot_ids
    }
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    teams["drift_2_refined_0"].write(folder, lambda _: None)
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before
