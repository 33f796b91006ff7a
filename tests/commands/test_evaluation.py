"""Tests of the command 'evaluate', run as a process on a fixture team."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

from octoreplay import evaluate_result
from octoreplay.report.evaluation_files import evaluation_csv, evaluation_json
from support.processes import octoreplay

FIXTURES = Path(__file__).parents[1] / "fixtures"


def fails(code: int, sentence: str, *arguments: object) -> None:
    done = octoreplay("evaluate", *arguments)
    assert done.returncode == code, done.stderr
    assert re.search(sentence, done.stderr), done.stderr
    assert "Traceback" not in done.stderr


@pytest.fixture(scope="session")
def trio(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("trio") / "trio.mcap"
    done = octoreplay("run", FIXTURES / "trio" / "team.yaml", "-o", path, "--state-every", "1", "--rule", "bayes")
    assert done.returncode == 0, done.stderr
    return path


def test_tables_files_and_figures(trio: Path, tmp_path: Path) -> None:
    truth = FIXTURES / "trio" / "world.npz"
    files = ("--csv", tmp_path / "e.csv", "--json", tmp_path / "e.json", "--plot", tmp_path / "figures")
    done = octoreplay("evaluate", trio, "--truth", truth, *files)
    assert (done.returncode, done.stderr) == (0, "")
    expected = evaluate_result(trio, truth=truth)
    assert (tmp_path / "e.csv").read_text() == evaluation_csv(expected)
    assert (tmp_path / "e.json").read_text() == evaluation_json(expected)
    for scores in expected.final.maps:
        assert re.search(rf"{scores.robot_id} +{scores.mean_iou:.3f} +{scores.mean_iou_known:.3f} ", done.stdout)
    for part in ("IoU of the classes", "Over time", "\nmean ", "\ncentral "):
        assert part in done.stdout
    made = [tmp_path / "e.csv", tmp_path / "e.json", *(tmp_path / "figures").iterdir()]
    assert len(made) == 7
    assert all(f"wrote {path}\n" in done.stdout for path in made)


def test_a_truth_beside_the_logs_is_named_but_not_used(trio: Path, tmp_path: Path) -> None:
    done = octoreplay("evaluate", trio, "--last")
    assert done.returncode == 0
    assert "IoU" not in done.stdout
    hint = "IoU, coverage and calibration need the ground truth: --truth WORLD; found beside the logs: "
    assert done.stderr.startswith(hint)
    assert Path(done.stderr.removeprefix(hint).strip()).resolve() == FIXTURES / "trio" / "world.npz"
    team = tmp_path / "team"
    shutil.copytree(FIXTURES / "trio", team)
    (team / "world.npz").unlink()
    assert octoreplay("run", "team.yaml", "-o", "out.mcap", "--duration", "1", folder=team).returncode == 0
    done = octoreplay("evaluate", team / "out.mcap", "--last")
    assert (done.returncode, done.stderr) == (
        0, "IoU, coverage and calibration need the ground truth: --truth WORLD\n",
    )  # fmt: skip


def test_a_rule_against_the_centralised_map_of_another_run(trio: Path, tmp_path: Path) -> None:
    local = tmp_path / "local.mcap"
    assert octoreplay("run", "--config-from", trio, "-o", local, "--rule", "local").returncode == 0
    done = octoreplay("evaluate", local, "--against", trio, "--last")
    assert done.returncode == 0
    assert f"agreement with the centralised map of {trio} " in " ".join(done.stdout.split())
    own, other = evaluate_result(local, over_time=False).final, evaluate_result(local, against=trio).final
    # The evidence is the same; only the settling ticks differ.
    assert other.mean("agreement") == pytest.approx(own.mean("agreement"))
    assert own.mean("agreement") < 0.9
    assert re.search(r"\ncentral +[\d,]+ +[\d.]+ bit +100\.00 % +100\.00 %\n", done.stdout)


def test_results_that_cannot_be_evaluated_are_reported_in_one_sentence(trio: Path, tmp_path: Path) -> None:
    (tmp_path / "empty.npz").write_bytes(b"")
    (tmp_path / "empty.mcap").write_bytes(b"")
    fails(1, r"^error: .*none\.mcap: cannot be read", tmp_path / "none.mcap")
    fails(1, r"^error: .*empty\.mcap: not a finished MCAP", tmp_path / "empty.mcap")
    fails(1, r"^error: .*empty\.npz: cannot be read", trio, "--truth", tmp_path / "empty.npz")
    fails(1, r"^error: .*world\.npz: not found", trio, "--truth", tmp_path)
    fails(1, r"^error: .*none\.mcap: cannot be read", trio, "--against", tmp_path / "none.mcap")
    fails(2, r"^error: .*must end in \.csv", trio, "--csv", tmp_path / "a.txt")
    fails(1, r"^error: .*the folder .* does not exist", trio, "--json", tmp_path / "none" / "a.json")
    fails(1, r"^error: .*empty\.npz: is a file; name a folder", trio, "--plot", tmp_path / "empty.npz")
    fails(2, "Missing argument")
