"""Runs in tiles on a dask cluster."""

from __future__ import annotations

import os
import pickle
import time
from pathlib import Path

import pytest

from octoreplay import __version__
from octoreplay.errors import ConfigError, InputError
from octoreplay.study.tiles import cluster_workers, worker
from octoreplay.study.tiles.cluster_workers import answer_on_worker, check_cluster
from octoreplay.study.tiles.worker import DiedError, Request, Setup
from support.clusters import Cluster, dask
from support.command_line import octoreplay_process, started, wait_for
from support.fixture_paths import TRIO_TEAM
from support.long_suite import long

__all__ = ["dask"]

ARGUMENTS = ("run", TRIO_TEAM, "-q", "--tiles", "9.6", "-o")


@pytest.fixture(scope="module")
def local(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Result of a run on this machine."""
    path = tmp_path_factory.mktemp("local") / "out.mcap"
    assert octoreplay_process(*ARGUMENTS, path).returncode == 0
    return path.read_bytes()


@long
def test_a_cluster_gives_the_same_bytes_when_a_worker_dies(dask: Cluster, tmp_path: Path, local: bytes) -> None:
    path = tmp_path / "out.mcap"
    with started(*ARGUMENTS, path, "--scheduler", dask.address) as process:
        wait_for(lambda: any((tmp_path / "out.tiles").glob("tile_*.ticks")))
        dask.workers[0].kill()
        _, errors = process.communicate(timeout=300)
    assert (process.returncode, errors) == (0, "")
    assert path.read_bytes() == local
    assert not (tmp_path / "out.tiles").exists()


@long
def test_processes_that_are_killed_on_workers_are_started_again(dask: Cluster, tmp_path: Path, local: bytes) -> None:
    path = tmp_path / "out.mcap"
    with started(*ARGUMENTS, path, "--scheduler", dask.address) as process:
        wait_for(lambda: any((tmp_path / "out.tiles").glob("tile_*.ticks")))
        _kill_a_child(dask)
        _, errors = process.communicate(timeout=300)
    assert process.returncode == 0
    assert "its process was killed by signal 9; it is started again" in errors
    assert path.read_bytes() == local


def _kill_a_child(dask: Cluster) -> None:
    """Kill a process that a worker has started."""
    pids = {worker.pid for worker in dask.workers}
    for folder in Path("/proc").iterdir():
        if folder.name.isdecimal():
            fields = (folder / "stat").read_text().rpartition(")")[2].split()
            if int(fields[1]) in pids and b"import serve" in (folder / "cmdline").read_bytes():
                os.kill(int(folder.name), 9)
                return
    raise AssertionError("no process")


@long
def test_a_lost_scheduler_keeps_what_is_finished(dask: Cluster, tmp_path: Path, local: bytes) -> None:
    path = tmp_path / "out.mcap"
    with started(*ARGUMENTS, path, "--scheduler", dask.address) as process:
        wait_for(lambda: any((tmp_path / "out.tiles").glob("tile_*.json")))
        dask.scheduler.kill()
        _, errors = process.communicate(timeout=300)
    assert process.returncode == 1
    assert f"error: {dask.address}: the connection to the scheduler was lost; continue with --resume" in errors
    assert "Traceback" not in errors
    assert octoreplay_process(*ARGUMENTS, path, "--resume").returncode == 0
    assert path.read_bytes() == local


def test_wrong_options_are_one_sentence() -> None:
    check_cluster("tcp://host:8786", 1, is_auto=True, has_limit=True)
    with pytest.raises(ConfigError, match=r"^scheduler: 'host' is not an address"):
        check_cluster("host", 1, is_auto=False, has_limit=False)
    with pytest.raises(ConfigError, match=r"^--jobs applies to this machine"):
        check_cluster("tcp://host:8786", 2, is_auto=False, has_limit=False)
    with pytest.raises(ConfigError, match=r"^tiles: the memory of a cluster's workers is unknown; give"):
        check_cluster("tcp://host:8786", 1, is_auto=True, has_limit=False)


def test_workers_with_another_version_or_folder_say_so(tmp_path: Path) -> None:
    answer = answer_on_worker("0.0", str(tmp_path), b"")
    assert isinstance(answer, InputError)
    assert str(answer) == (
        f"the worker has octoreplay {__version__}, the run 0.0; install the same version, and --resume"
    )
    answer = answer_on_worker(__version__, str(tmp_path / "missing" / "running-1"), b"")
    assert isinstance(answer, InputError)
    assert str(answer).startswith(f"the worker cannot see '{tmp_path / 'missing'}'; workers need")


def test_a_request_ends_with_its_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster_workers, "_POLL_SECONDS", 0.05)
    marker = tmp_path / "running-1"
    marker.touch()
    monkeypatch.setattr(worker.WorkerProcess, "answer", lambda self, request: _removes(marker, self))
    killed: list[bool] = []
    monkeypatch.setattr(worker.WorkerProcess, "kill", lambda self: killed.append(True))
    data = pickle.dumps((Setup(None, tmp_path, 1), Request("tile_0_0", print)))  # type: ignore[arg-type]  # not used
    assert isinstance(answer_on_worker(__version__, str(marker), data), DiedError)
    assert killed == [True]


def _removes(marker: Path, process: object) -> None:
    """Remove the marker, as the end of a run does, and wait for the end of the process."""
    marker.unlink()
    time.sleep(0.5)
    raise DiedError("was killed by signal 9")
