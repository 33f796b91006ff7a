"""Compilation in a second process: it starts once, it ends with the replay, and it compiles kernels of a replay."""

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
"""Prints the signatures of each kernel that a replay uses, or the warm-up where no team is given."""


def signatures_used(*arguments):
    """{kernel: its signatures} of the kernels that Python calls."""
    command = [sys.executable, "-c", SIGNATURES, *map(str, arguments)]
    for _ in range(2):
        # In the second process all kernels come from the cache, and kernels called by kernels have no signatures.
        done = subprocess.run(command, capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


@pytest.mark.long
def test_compiled_signatures_are_those_of_a_replay(tmp_path):
    replay, compiled = signatures_used(TEAM, tmp_path / "result.mcap"), signatures_used()
    assert {name: replay.get(name) for name in compiled} == compiled
    # The kernels that take longest to compile, without those that a replay needs first.
    names = {name.rpartition(".")[2] for name in compiled}
    assert {"depth_to_runs", "mark_free", "read_words", "team_step", "finish_step", "apply_marks"} <= names


def test_process_exits_when_its_input_closes(tmp_path):
    command = [sys.executable, "-P", "-m", warm_up.__name__]
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    subprocess.run(command, env=environment, input=b"", capture_output=True, check=True, timeout=300)
    assert not list(tmp_path.rglob("*team_step*"))


@pytest.fixture
def started(tmp_path, monkeypatch):
    """Second processes that are started, in an environment with an empty cache and two cores."""
    processes = []
    start = warm_up._start

    def recorded_start():
        processes.append(start())
        return processes[-1]

    monkeypatch.setattr(warm_up, "_start", recorded_start)
    monkeypatch.setattr(warm_up, "_num_cores", lambda: 2)
    monkeypatch.setattr(compiler, "_CACHE_FOLDER", tmp_path)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    return processes


def test_process_is_started_and_ended(started, capfd):
    with warm_up.second_compiler():
        assert [process.poll() for process in started] == [None]
    assert len(started) == 1
    assert started[0].returncode is not None
    assert capfd.readouterr() == ("", "")


def test_process_is_ended_when_the_replay_fails(started):
    with pytest.raises(KeyError), warm_up.second_compiler():
        raise KeyError
    assert started[0].returncode is not None


def test_no_process_is_started_with_a_filled_cache(started, tmp_path):
    (tmp_path / "consensus.team_step-0123.kernel").touch()
    with warm_up.second_compiler():
        pass
    assert not started


def test_compile_if_needed_compiles_with_an_empty_cache_only(tmp_path, monkeypatch):
    calls = []
    monkeypatch.setattr(warm_up, "compile_kernels", lambda: calls.append(1))
    monkeypatch.setattr(compiler, "_CACHE_FOLDER", tmp_path)
    warm_up.compile_if_needed()
    assert calls == [1]
    (tmp_path / "consensus.team_step-0123.kernel").touch()
    warm_up.compile_if_needed()
    assert calls == [1]


@pytest.mark.parametrize("change", [(warm_up, "_num_cores", lambda: 1), (compiler, "_CACHE_FOLDER", None)])
def test_no_process_is_started_on_one_core_or_without_a_cache(change, started, monkeypatch):
    monkeypatch.setattr(*change)
    with warm_up.second_compiler():
        pass
    assert not started


@pytest.mark.parametrize("interpreter", ["", "/no/such/python"])
def test_replay_continues_where_no_process_can_be_started(interpreter, started, monkeypatch):
    monkeypatch.setattr(sys, "executable", interpreter)
    with warm_up.second_compiler():
        assert started == [None]
