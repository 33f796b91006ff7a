"""The command that repeats all experiments."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from octoreplay.cli import cli
from octoreplay.commands import experiments
from octoreplay.study.questions import QUESTIONS
from support.command_line import assert_fails


@pytest.mark.parametrize("has_data", [False, True])
def test_all_experiments_run_one_after_the_other_with_shared_teams(
    has_data: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for index in range(64):
        (tmp_path / f"frame-{index:06d}.depth.png").touch()
        (tmp_path / f"frame-{index:06d}.pose.txt").write_text("1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    answered: list[tuple[Any, ...]] = []

    def answer(name: str, teams: Any, folder: Path, **run: Any) -> list[Path]:
        answered.append((name, folder, run))
        assert teams.plans
        return [folder / "tables.md"]

    monkeypatch.setattr(experiments, "_answer", answer)
    folder = tmp_path / "all"
    data = ["--data", str(tmp_path)] if has_data else []
    done = CliRunner().invoke(cli, ["experiment", "all", str(folder), "--jobs", "3", "--json", *data])
    assert done.exit_code == 0, done.output
    names = [name for name in QUESTIONS if has_data or name not in ("real", "prediction")]
    assert sorted(name for name, *_ in answered) == sorted(names)
    assert all(
        entry[1:] == (folder / entry[0], {"teams_folder": folder / "teams", "num_jobs": 3}) for entry in answered
    )
    assert len(json.loads(done.stdout)["written"]) == len(names)


def test_teams_in_a_file_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "teams.txt"
    path.touch()
    reason = "teams.txt: is a file; name a folder"
    assert_fails(1, reason, "experiment", "graphs", tmp_path / "out", "--teams", path)
    assert not (tmp_path / "out").exists()
