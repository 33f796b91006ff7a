"""Tests of sweeps over the fixture with two robots: interruption, resumption, failures and locking."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from octoreplay import __version__
from octoreplay.config.team_file import load_team_file
from octoreplay.errors import ConfigError, InputError, OutputError
from octoreplay.replay.run import replay_team
from octoreplay.result import open_result
from octoreplay.study import local
from octoreplay.study.folder import SweepFolder
from octoreplay.study.numbers import run_numbers
from octoreplay.study.process import TaskProcess
from octoreplay.study.sweep import SweepProgress, run_sweep
from octoreplay.study.task import Task
from support.command_line import octoreplay, started, wait_for
from support.fixture_paths import PAIR, PAIR_TEAM
from support.sweeps import QUICK, children, is_running, table

pytestmark = pytest.mark.long

GRID = ("--vary", "rule=gradient,bayes", "--vary", "loss=0,0.3", *QUICK)
SETTINGS = {"resolution": 0.6, "duration": 2.0}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of an undisturbed sweep."""
    folder = tmp_path_factory.mktemp("sweep") / "whole"
    done = octoreplay("sweep", PAIR_TEAM, *GRID, "-o", folder)
    assert (done.returncode, done.stdout, done.stderr) == (
        0, f"wrote {folder / 'table.csv'} (4 runs), figures in {folder / 'figures'}\n", "",
    )  # fmt: skip
    return folder


def rows_in(folder: Path) -> dict[str, int]:
    """Modification times of the row files by name."""
    return {path.name: path.stat().st_mtime_ns for path in (folder / "rows").glob("*.json")}


def test_a_row_equals_the_numbers_of_a_single_run(whole: Path, tmp_path: Path) -> None:
    rows = table(whole)
    assert [(row["rule"], row["loss"]) for row in rows] == [
        (rule, loss) for rule in ("gradient", "bayes") for loss in ("0", "0.3")
    ]
    config = load_team_file(PAIR_TEAM).with_parameters({**SETTINGS, "rule": "bayes", "loss": 0.3})
    summary = replay_team(config, tmp_path / "result.mcap")
    with open_result(tmp_path / "result.mcap") as result:
        expected = run_numbers(summary, result.metrics)
    assert {name: rows[3][name] for name in expected} == {name: str(value) for name, value in expected.items()}
    assert {"team": "team", "status": "ok", "error": "", "seed": "0"}.items() <= rows[3].items()


def test_the_folder_of_a_finished_sweep(whole: Path) -> None:
    assert {path.name for path in whole.iterdir()} == {"figures", "rows", "sweep.json", "table.csv"}
    description = json.loads((whole / "sweep.json").read_text())
    assert description["teams"] == {"team": str(PAIR_TEAM)}
    assert description["vary"] == {"rule": ["gradient", "bayes"], "loss": ["0", "0.3"]}
    assert len(description["runs"]) == 4
    assert (whole / "figures" / "agreement.png").stat().st_size > 1000


def test_a_killed_sweep_continues_to_the_same_table(whole: Path, tmp_path: Path) -> None:
    arguments = (PAIR_TEAM, *GRID, "-o", tmp_path / "s", "--jobs", 1)
    with started("sweep", *arguments) as process:
        wait_for(lambda: len(rows_in(tmp_path / "s")) >= 1 and len(children(process)) == 1)
        running = children(process)
    wait_for(lambda: not any(map(is_running, running)), 10)
    finished = rows_in(tmp_path / "s")
    assert 1 <= len(finished) < 4
    done = octoreplay("sweep", *arguments)
    assert done.returncode == 0, done.stderr
    assert f"(4 runs, {len(finished)} of them before)" in done.stdout
    assert table(tmp_path / "s") == table(whole)
    assert finished.items() <= rows_in(tmp_path / "s").items()
    assert not list((tmp_path / "s").glob("unfinished*"))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_an_interrupted_sweep_ends_its_processes_and_reports_it(tmp_path: Path, number: signal.Signals) -> None:
    # Runs that do not stop settling.
    endless = ("--vary", "loss=0,0.25,0.5", "--settle", "100000", "--settle-max", "100000", *QUICK)
    with started("sweep", PAIR_TEAM, *endless, "-o", tmp_path / "s") as process:
        wait_for(lambda: any((tmp_path / "s").glob("unfinished-*/*.mcap")))
        running = children(process)
        assert running
        process.send_signal(number)
        _, err = process.communicate(timeout=60)
    if number == signal.SIGKILL:
        wait_for(lambda: not any(map(is_running, running)), 10)
        return
    assert process.returncode == 130
    # click writes a line feed first, to end the terminal's line with ^C.
    assert err == "\ninterrupted; 0 of 3 runs are finished, and the same command continues with the others\n"
    assert not any(map(is_running, running))
    assert not list((tmp_path / "s").glob("unfinished*"))


def test_damaged_row_files_are_replaced(whole: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(whole, tmp_path / "s")
    first, second, third = sorted((folder / "rows").iterdir())[:3]
    first.write_bytes(first.read_bytes()[:-40])
    second.write_text("[]")
    third.rename(third.with_name(f".{third.name}.0a1b2c3d.tmp"))
    done = octoreplay("sweep", PAIR_TEAM, *GRID, "-o", folder)
    assert "(4 runs, 1 of them before)" in done.stdout
    assert table(folder) == table(whole)
    assert not list((folder / "rows").glob(".*"))


def test_a_failed_run_does_not_stop_the_others_and_is_repeated(tmp_path: Path) -> None:
    arguments = (PAIR_TEAM, "--vary", "start=99,0", "--resolution", "0.6", "-o", tmp_path)
    for others in ("2 runs", "2 runs, 1 of them before"):
        done = octoreplay("sweep", *arguments)
        assert done.returncode == 1
        assert f"({others})" in done.stdout
        assert re.fullmatch(
            "warning: failed: team=team, start=99, seed=0: no robot has a frame that can be used[^\n]*\n", done.stderr
        )
    bad, good = table(tmp_path)
    assert (good["status"], bad["status"]) == ("ok", "failed")
    assert bad["error"].startswith("no robot has a frame")
    assert {bad[name] for name in bad if name not in ("team", "start", "seed", "status", "error")} == {""}


def test_a_killed_process_is_a_failed_run(tmp_path: Path) -> None:
    task = Task("x", "k", {}, "", str(tmp_path / "u"), str(tmp_path / "r"), False, None, __version__, 1)
    process = TaskProcess(task)
    process.kill()
    row = process.wait(30)
    assert row is not None
    assert row["status"] == "failed"
    assert row["error"].startswith("killed by signal 9 (SIGKILL); the system may be out of memory")


def test_lost_data_gives_exit_code_3_and_no_repetition(tmp_path: Path) -> None:
    team = shutil.copytree(PAIR, tmp_path / "pair") / "team.yaml"
    log = team.with_name("husky_2.mcap")
    log.write_bytes(log.read_bytes()[: log.stat().st_size // 2])
    for _ in range(2):
        done = octoreplay("sweep", team, "--resolution", "0.6", "-o", tmp_path / "s")
        assert (done.returncode, done.stderr) == (3, "")
    assert "(1 runs, 1 of them before)" in done.stdout
    (row,) = table(tmp_path / "s")
    assert row["status"] == "data lost"
    assert row["error"].startswith("husky_2: ")


def test_a_run_is_repeated_if_its_inputs_change(tmp_path: Path) -> None:
    team = shutil.copytree(PAIR, tmp_path / "pair") / "team.yaml"

    def num_earlier(**settings: object) -> int:
        return run_sweep(team, ["rule=local"], tmp_path / "s", settings={**SETTINGS, **settings}).num_earlier

    assert num_earlier() == 0
    assert num_earlier() == 1
    assert num_earlier(hit=0.5) == 0
    assert num_earlier(hit=0.5) == 1
    with (tmp_path / "pair" / "husky_1.mcap").open("ab") as log:
        log.write(b"\0")
    assert num_earlier(hit=0.5) == 0


def test_other_combinations_use_finished_runs_again(whole: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(whole, tmp_path / "s")
    done = run_sweep(PAIR_TEAM, ["rule=bayes,local", "loss=0.3"], folder, settings=SETTINGS)
    assert [(row["rule"], row["status"]) for row in done.rows] == [("bayes", "ok"), ("local", "ok")]
    assert done.num_earlier == 1
    assert table(folder)[0] == table(whole)[3]


def test_a_run_is_repeated_if_its_kept_result_is_missing(tmp_path: Path) -> None:
    for _ in range(2):
        done = run_sweep([PAIR_TEAM], ["rule=bayes"], tmp_path / "s", settings=SETTINGS, keep=True)
        result = tmp_path / "s" / "runs" / "team=team,rule=bayes,seed=0.mcap"
        with open_result(result) as opened:
            assert opened.config.consensus.rule == "bayes"
            assert opened.summary.last.total_distance_all == done.rows[0]["total_distance_all"]
        assert done.num_earlier == 0
        result.unlink()


def test_labels_of_teams_are_distinct(tmp_path: Path) -> None:
    for name in ("one", "two"):
        shutil.copytree(PAIR, tmp_path / name)
    steps: list[SweepProgress] = []
    teams = [tmp_path / "one" / "team.yaml", tmp_path / "two" / "team.yaml"]
    done = run_sweep(teams, [], tmp_path / "s", settings=SETTINGS, num_seeds=2, progress=steps.append, num_jobs=2)
    assert [(row["team"], row["seed"]) for row in done.rows] == [
        ("one/team", 0), ("one/team", 1), ("two/team", 0), ("two/team", 1),
    ]  # fmt: skip
    assert [step.num_finished for step in steps] == [0, 1, 2, 3, 4]
    assert steps[-1] == SweepProgress(4, 0, 4, 0.0)
    with pytest.raises(ConfigError, match="a team file is given twice"):
        run_sweep([PAIR_TEAM, PAIR_TEAM], [], tmp_path / "s")


def test_a_folder_in_use_is_refused(tmp_path: Path) -> None:
    with SweepFolder.locked(tmp_path / "s"):
        done = octoreplay("sweep", PAIR_TEAM, "-o", tmp_path / "s", *QUICK)
    assert done.returncode == 1
    assert done.stderr.startswith(f"error: {tmp_path / 's'}: is being written by process {os.getpid()} on ")


def test_a_folder_with_other_files_is_refused(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").touch()
    with pytest.raises(OutputError, match="is not empty and holds no sweep; use another folder"):
        run_sweep(PAIR_TEAM, [], tmp_path)
    with pytest.raises(OutputError, match=r"thesis\.txt: cannot be written: "):
        run_sweep(PAIR_TEAM, [], tmp_path / "thesis.txt")


def test_invalid_options_are_reported_before_any_run(tmp_path: Path) -> None:
    for arguments, code, sentence in (
        (["--vary", "rule=bays"], 2, "error: rule=bays: "),
        (["--vary", "rule"], 2, "error: vary: 'rule' is not NAME=VALUE"),
        (["--jobs", "0"], 2, "error: jobs: 0 is below the least value 1"),
        (["--threads", "0"], 2, "error: threads: 0 is below the least value 1"),
        (["--seeds", "0"], 2, "error: seeds: 0 is below the least value 1"),
        (["--truth", "none.npz"], 1, f"error: none.npz: not found, neither beside {PAIR_TEAM} nor in"),
    ):
        done = octoreplay("sweep", PAIR_TEAM, *arguments, "-o", tmp_path / "s")
        assert done.returncode == code, done.stderr
        assert done.stderr.startswith(sentence)
        assert done.stderr.count("\n") == 1
    assert not (tmp_path / "s").exists()
    with pytest.raises(InputError, match="not found"):
        run_sweep(PAIR_TEAM, [], tmp_path / "s", truth="none.npz")


def test_each_worker_has_a_processor_of_its_own() -> None:
    allowed = sorted(os.sched_getaffinity(0))
    code = "import os; print(*sorted(os.sched_getaffinity(0)))"
    found: dict[int, str] = {}

    def record_processors(slot: int) -> None:
        local._pin(slot, 1)
        found[slot] = subprocess.run([sys.executable, "-c", code], text=True, capture_output=True, check=True).stdout

    threads = [threading.Thread(target=record_processors, args=(slot,)) for slot in range(len(allowed))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == {slot: f"{cpu}\n" for slot, cpu in enumerate(allowed)}
    assert sorted(os.sched_getaffinity(0)) == allowed


def test_a_sweep_with_truth_has_scores(tmp_path: Path) -> None:
    done = run_sweep(PAIR_TEAM, ["rule=bayes"], tmp_path, settings={"resolution": 0.3}, truth="world.npz")
    (row,) = done.rows
    assert row["status"] == "ok", row["error"]
    assert 0.1 < row["mean_iou"] <= 1.0
    assert 0.1 < row["central_mean_iou"] <= 1.0
