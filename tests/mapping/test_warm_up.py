"""The second process that compiles kernels: it is started once, it ends, and a replay needs what it compiles."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from octoreplay.mapping import warm_up
from octoreplay.mapping.kernels import compiler

TEAM = Path(__file__).parents[1] / "fixtures" / "pair" / "team.yaml"

SIGNATURES = """
import json, sys
from pathlib import Path
from octoreplay.config.team_file import load_team_file
from octoreplay.mapping import warm_up
from octoreplay.replay.run import replay_team
if sys.argv[1:]:
    team, result = map(Path, sys.argv[1:])
    replay_team(load_team_file(team), result)
else:
    warm_up.compile_kernels()
kernels = {
    f"{module}.{name}": [str(signature) for signature in kernel.signatures]
    for module in sorted(sys.modules) if module.startswith("octoreplay.mapping.kernels.")
    for name, kernel in vars(sys.modules[module]).items() if getattr(kernel, "signatures", None)
}
print(json.dumps(kernels))
"""
"""Prints the signatures of each kernel that a replay uses, or the warm-up where no team is named."""


def signatures_used(*arguments):
    """{kernel: its signatures}, of those that Python calls."""
    command = [sys.executable, "-c", SIGNATURES, *map(str, arguments)]
    for _ in range(2):
        # The second time all kernels are loaded, and those that others call are not looked at.
        done = subprocess.run(command, capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


def test_what_it_compiles_is_what_a_replay_needs(tmp_path):
    replay, compiled = signatures_used(TEAM, tmp_path / "result.mcap"), signatures_used()
    assert {name: replay.get(name) for name in compiled} == compiled
    # The kernels that take longest, except those that a replay comes to first.
    names = {name.rpartition(".")[2] for name in compiled}
    assert {"depth_to_runs", "mark_free", "read_words", "team_step", "finish_step", "apply_marks"} <= names


def test_it_ends_with_its_input(tmp_path):
    command = [sys.executable, "-P", "-m", warm_up.__name__]
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    subprocess.run(command, env=environment, input=b"", capture_output=True, check=True, timeout=300)
    assert not list(tmp_path.rglob("*team_step*"))


@pytest.fixture
def started(tmp_path, monkeypatch):
    """The second processes that are started; for this one and for them there are no kernels yet, and two cores."""
    processes = []
    start = warm_up._start

    def start_and_tell():
        processes.append(start())
        return processes[-1]

    monkeypatch.setattr(warm_up, "_start", start_and_tell)
    monkeypatch.setattr(warm_up, "_num_cores", lambda: 2)
    monkeypatch.setattr(compiler, "_CACHE_FOLDER", str(tmp_path))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    return processes


def test_one_is_started_and_ended(started, capfd):
    with warm_up.second_compiler():
        assert [process.poll() for process in started] == [None]
    assert len(started) == 1
    assert started[0].returncode is not None
    assert capfd.readouterr() == ("", "")


def test_it_is_ended_when_the_replay_fails(started):
    with pytest.raises(KeyError), warm_up.second_compiler():
        raise KeyError
    assert started[0].returncode is not None


def test_none_is_started_where_there_are_kernels(started, tmp_path):
    (tmp_path / "kernels").mkdir()
    (tmp_path / "kernels" / "consensus.team_step-154.py311.nbi").touch()
    with warm_up.second_compiler():
        pass
    assert not started


@pytest.mark.parametrize("change", [(warm_up, "_num_cores", lambda: 1), (compiler, "_CACHE_FOLDER", None)])
def test_none_is_started_in_vain(change, started, monkeypatch):
    monkeypatch.setattr(*change)
    with warm_up.second_compiler():
        pass
    assert not started


@pytest.mark.parametrize("interpreter", ["", "/no/such/python"])
def test_a_replay_goes_on_where_none_can_be_started(interpreter, started, monkeypatch):
    monkeypatch.setattr(sys, "executable", interpreter)
    with warm_up.second_compiler():
        assert started == [None]
