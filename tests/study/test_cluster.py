"""Tests of sweeps on a dask scheduler with two workers, started as processes."""

from __future__ import annotations

import dataclasses
import signal
import sys
from pathlib import Path

import pytest

from octoreplay import __version__
from octoreplay.errors import ConfigError, InputError
from octoreplay.study import cluster, dask_client
from octoreplay.study.sweep import check_workers
from octoreplay.study.task import Task
from support.clusters import Cluster, dask
from support.command_line import octoreplay_process, started, wait_for
from support.fixture_paths import PAIR_TEAM
from support.sweeps import QUICK, is_running, table

pytestmark = pytest.mark.long

__all__ = ["dask"]

GRID = ("--vary", "rule=gradient,bayes", "--vary", "loss=0,0.3", *QUICK)
ENDLESS = ("--settle", "100000", "--settle-max", "100000", *QUICK)


def test_a_cluster_gives_the_same_table(dask: Cluster, tmp_path: Path) -> None:
    done = octoreplay_process("sweep", PAIR_TEAM, *GRID, "-o", tmp_path / "d", "--scheduler", dask.address)
    assert done.returncode == 0, done.stderr
    assert done.stdout == f"wrote {tmp_path / 'd' / 'table.csv'} (4 runs), figures in {tmp_path / 'd' / 'figures'}\n"
    assert octoreplay_process("sweep", PAIR_TEAM, *GRID, "-o", tmp_path / "s").returncode == 0
    assert table(tmp_path / "d") == table(tmp_path / "s")
    done = octoreplay_process("sweep", PAIR_TEAM, *GRID, "-o", tmp_path / "s", "--scheduler", dask.address)
    assert "(4 runs, 4 of them before)" in done.stdout


def test_a_lost_worker_and_a_failed_run_do_not_stop_the_sweep(dask: Cluster, tmp_path: Path) -> None:
    arguments = ("--vary", "start=99,0,1", *QUICK, "-o", tmp_path / "d", "--scheduler", dask.address)
    with started("sweep", PAIR_TEAM, *arguments) as process:
        wait_for(lambda: bool(dask.children()))
        dask.workers[0].kill()
        out, err = process.communicate(timeout=120)
    assert process.returncode == 1
    assert "(3 runs)" in out
    assert "failed: team=team, start=99, seed=0: no robot has a frame" in err
    assert "Traceback" not in err
    assert [row["status"] for row in table(tmp_path / "d")] == ["failed", "ok", "ok"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_an_interrupted_sweep_ends_its_processes_on_the_workers(
    dask: Cluster, tmp_path: Path, number: signal.Signals
) -> None:
    arguments = ("-o", tmp_path / "d", "--scheduler", dask.address)
    with started("sweep", PAIR_TEAM, *ENDLESS, *arguments) as process:
        wait_for(lambda: any((tmp_path / "d").glob("unfinished-*/*.mcap")))
        running = dask.children()
        assert len(running) == 1
        process.send_signal(number)
        _, err = process.communicate(timeout=60)
    if number == signal.SIGKILL:
        # A killed sweep cannot stop its workers. The next sweep removes the folder of unfinished results.
        done = octoreplay_process("sweep", PAIR_TEAM, *QUICK, *arguments)
        assert done.returncode == 0, done.stderr
    else:
        assert process.returncode == 130
        assert "interrupted; 0 of 1 runs are finished" in err
        assert "Traceback" not in err
    wait_for(lambda: not is_running(running[0]), 20)


def test_a_lost_scheduler_is_reported_in_one_sentence(dask: Cluster, tmp_path: Path) -> None:
    with started("sweep", PAIR_TEAM, *ENDLESS, "-o", tmp_path / "d", "--scheduler", dask.address) as process:
        wait_for(lambda: any((tmp_path / "d").glob("unfinished-*/*.mcap")))
        dask.scheduler.kill()
        _, err = process.communicate(timeout=120)
    assert process.returncode == 1
    assert err.splitlines()[-1] == (
        f"error: {dask.address}: the connection to the scheduler was lost; finished runs are kept, and the same command"
        " continues with the others"
    )
    assert "Traceback" not in err


def test_an_unusable_scheduler_is_reported_in_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    task = some_task(tmp_path)
    monkeypatch.setattr(dask_client, "_CONNECT_SECONDS", 1.0)
    with pytest.raises(InputError, match=r"tcp://127\.0\.0\.1:9: no dask scheduler answered within 1 s; start one"):
        list(cluster.execute_on_cluster([task], "tcp://127.0.0.1:9"))
    for address in ("here", "http://127.0.0.1:80", "tcp://here", "tcp://:x"):
        with pytest.raises(ConfigError, match=f"scheduler: '{address}' is not an address such as tcp://host:8786"):
            check_workers(None, 1, address)
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ConfigError, match=r"not installed; use pip install 'octoreplay\[cluster\]'"):
        list(cluster.execute_on_cluster([task], "tcp://127.0.0.1:9"))


def test_jobs_and_scheduler_exclude_each_other(tmp_path: Path) -> None:
    done = octoreplay_process("sweep", PAIR_TEAM, "-o", tmp_path / "d", "--jobs", 2, "--scheduler", "tcp://127.0.0.1:9")
    assert done.returncode == 2
    assert "--jobs applies to this machine and --scheduler to a cluster; leave one out" in done.stderr


def some_task(folder: Path) -> Task:
    unfinished = str(folder / "none" / "u.mcap")
    return Task("x", "k", {}, "", unfinished, str(folder / "r"), False, None, __version__, 1)


def test_a_worker_that_cannot_execute_a_task_returns_the_reason(tmp_path: Path) -> None:
    content = dataclasses.asdict(some_task(tmp_path))
    assert cluster.execute_on_worker(content)["error"] == (
        f"the worker cannot see '{tmp_path / 'none'}'; workers need the sweep's folder and the logs at the same paths"
    )
    # Another version may have other fields in its tasks.
    row = cluster.execute_on_worker({"version": "0.0.1", "wheels": 4})
    assert row["status"] == "failed"
    assert row["error"] == f"the worker has octoreplay {__version__}, the sweep 0.0.1; install the same version"
