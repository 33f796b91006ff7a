"""The command 'evaluate' on a recorded team."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest

from octoreplay import evaluate_result
from octoreplay.io.text_files import json_text
from octoreplay.report.evaluation_files import evaluation_content, evaluation_csv
from support.command_line import assert_fails, octoreplay
from support.fixture_paths import TRIO
from support.long_suite import long


@long
def test_tables_files_and_figures(trio_result: Path, tmp_path: Path) -> None:
    truth = TRIO / "world.npz"
    files = ("--csv", tmp_path / "e.csv", "--plot", tmp_path / "figures")
    done = octoreplay("evaluate", trio_result, "--truth", truth, *files)
    assert (done.returncode, done.stderr) == (0, "")
    expected = evaluate_result(trio_result, truth=truth)
    assert (tmp_path / "e.csv").read_text() == evaluation_csv(expected)
    for scores in expected.final.maps:
        assert re.search(
            rf"{scores.robot_id} +{scores.truth.mean_iou:.3f} +{scores.truth.mean_iou_known:.3f} ", done.stdout
        )
    for part in ("IoU of the classes", "Over time", "\nmean ", "\ncentral "):
        assert part in done.stdout
    made = [tmp_path / "e.csv", *(tmp_path / "figures").iterdir()]
    assert len(made) == 6
    assert all(f"wrote {path}\n" in done.stdout for path in made)


def test_the_document_is_the_evaluation(trio_result: Path) -> None:
    done = octoreplay("evaluate", trio_result, "--truth", TRIO / "world.npz", "--last", "--json")
    document = json.loads(done.stdout)
    expected = evaluate_result(trio_result, truth=TRIO / "world.npz", over_time=False)
    assert document == {
        **json.loads(json_text(evaluation_content(expected))), "command": "evaluate", "written": [], "warnings": [],
    }  # fmt: skip


@long
def test_the_truth_beside_the_logs_is_suggested_and_not_used(trio_result: Path, tmp_path: Path) -> None:
    done = octoreplay("evaluate", trio_result, "--last")
    assert done.returncode == 0
    assert "IoU" not in done.stdout
    hint = "IoU, coverage and calibration need the ground truth: --truth WORLD; found beside the logs: "
    assert done.stderr.startswith(hint)
    assert Path(done.stderr.removeprefix(hint).strip()).resolve() == TRIO / "world.npz"
    team = tmp_path / "team"
    shutil.copytree(TRIO, team)
    (team / "world.npz").unlink()
    assert octoreplay("run", "team.yaml", "-o", "out.mcap", "--duration", "1", folder=team).returncode == 0
    done = octoreplay("evaluate", team / "out.mcap", "--last")
    assert (done.returncode, done.stderr) == (
        0, "IoU, coverage and calibration need the ground truth: --truth WORLD\n",
    )  # fmt: skip


def test_a_truth_in_another_frame_is_named(trio_result: Path, tmp_path: Path) -> None:
    shutil.copy(TRIO / "world.npz", tmp_path)
    frames = tmp_path / "frames.yaml"
    near, far = "[0.5, 0, 0, 0, 0, 0, 1]", "[9, 0, 0, 0, 0, 0, 1]"
    for places, is_named in (((near, far, far), False), ((far, far, far), True)):
        frames.write_text("T_team_map:\n" + "".join(f"  husky_{n}: {place}\n" for n, place in enumerate(places, 1)))
        done = octoreplay("evaluate", trio_result, "--truth", tmp_path, "--last")
        assert done.returncode == 0, done.stderr
        named = f"so the scores mean nothing: give husky_1 its T_team_map from {frames}, then align and run again"
        assert (named in done.stderr) == is_named


@long
def test_a_rule_against_the_centralised_map_of_another_run(trio_result: Path, tmp_path: Path) -> None:
    local = tmp_path / "local.mcap"
    assert octoreplay("run", "--config-from", trio_result, "-o", local, "--rule", "local").returncode == 0
    done = octoreplay("evaluate", local, "--against", trio_result, "--last")
    assert done.returncode == 0
    assert f"agreement with the centralised map of {trio_result} " in " ".join(done.stdout.split())
    own, other = evaluate_result(local, over_time=False).final, evaluate_result(local, against=trio_result).final
    # The evidence is the same; only the settling ticks differ.
    assert other.mean("agreement") == pytest.approx(own.mean("agreement"))
    assert own.mean("agreement") < 0.9
    assert re.search(r"\ncentral +[\d,]+ +[\d.]+ bit +100\.00 % +100\.00 %\n", done.stdout)


def test_refused_inputs_and_outputs(trio_result: Path, tmp_path: Path) -> None:
    (tmp_path / "empty.npz").write_bytes(b"")
    (tmp_path / "empty.mcap").write_bytes(b"")
    for code, sentence, arguments in (
        (1, r"none\.mcap: cannot be read", (tmp_path / "none.mcap",)),
        (1, r"empty\.mcap: not a finished MCAP", (tmp_path / "empty.mcap",)),
        (1, r"empty\.npz: cannot be read", (trio_result, "--truth", tmp_path / "empty.npz")),
        (1, r"world\.npz: not found", (trio_result, "--truth", tmp_path)),
        (1, r"none\.mcap: cannot be read", (trio_result, "--against", tmp_path / "none.mcap")),
        (2, r"must end in \.csv", (trio_result, "--csv", tmp_path / "a.txt")),
        (1, r"the folder .* does not exist", (trio_result, "--csv", tmp_path / "none" / "a.csv")),
        (1, r"empty\.npz: is a file; name a folder", (trio_result, "--plot", tmp_path / "empty.npz")),
    ):
        assert_fails(code, f"^error: .*{sentence}", "evaluate", *arguments)
    assert_fails(2, "Missing argument", "evaluate")
