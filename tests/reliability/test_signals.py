"""Signals at any moment: exit code 130 with the old output or a valid partial, or 0 with the complete new output."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from octoreplay.io.results.unfinished import has_messages
from support.fixture_paths import PAIR_TEAM
from support.forked import Done, ForkServer
from support.long_suite import long
from support.outcomes import QUICK_RUN, check_partial, content, one_sentence
from support.trials import Trials

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
COMMANDS = {
    "run": QUICK_RUN,
    "metrics": ("metrics", "r.mcap", "--force", "--csv", "m.csv"),
    "export": ("export", "r.mcap", "--force", "-o", "m.ply"),
}
OUTPUTS = {"run": "x.mcap", "metrics": "m.csv", "export": "m.ply"}


@pytest.fixture(scope="module")
def whole(server: ForkServer, results: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the outputs of all commands."""
    folder = tmp_path_factory.mktemp("whole")
    for name in ("r.mcap", "x.mcap"):
        shutil.copy(results / "r.mcap", folder / name)
    return folder


def fresh(folder: Path, whole: Path, name: str) -> Path:
    """Make a folder with the inputs and the old output of a command."""
    folder.mkdir()
    if name != "run":
        shutil.copy(whole / "r.mcap", folder)
    (folder / OUTPUTS[name]).write_bytes(b"old")
    return folder


def check(name: str, done: Done, folder: Path, whole: Path) -> None:
    """Check exit code and files after a signal."""
    one_sentence(done)
    assert done.code in (0, 130), done
    left = content(folder)
    left.pop("r.mcap", None)
    new = (whole / OUTPUTS[name]).read_bytes()
    assert left.pop(OUTPUTS[name]) == (new if done.code == 0 else b"old"), done
    if left.pop("x.partial.mcap", None) is not None:
        assert "interrupted; the finished part is in x.partial.mcap" in done.err
        check_partial(folder / "x.partial.mcap", whole / "x.mcap")
    assert not left
    assert not list(folder.rglob(".*"))
    shutil.rmtree(folder)


@long
@pytest.mark.parametrize("name", COMMANDS)
def test_a_signal_at_any_call_of_a_function(
    name: str, whole: Path, server: ForkServer, trials: Trials, tmp_path: Path
) -> None:
    trials.only_in_a_campaign(unless=name == "run")
    folder = fresh(tmp_path / "work", whole, name)
    count = server.run(*COMMANDS[name], folder=folder, calls_until=0).count
    shutil.copy(folder / OUTPUTS[name], whole)
    shutil.rmtree(folder)
    codes = []
    for random in trials.rounds(2, 200):
        folder = fresh(tmp_path / "work", whole, name)
        # Half of the signals fall into the last part, where the output gets its name.
        at = count - int(random.integers(200)) if random.random() < 0.5 else int(random.integers(1, count + 1))
        number = random.choice(SIGNALS)
        done = server.run(*COMMANDS[name], folder=folder, calls_until=max(at, 1), signal=int(number))
        check(name, done, folder, whole)
        codes.append(done.code)
    print(f"{name}: {codes.count(0)} complete, {codes.count(130)} interrupted")


@pytest.mark.parametrize("name", COMMANDS)
def test_a_signal_at_any_time(name: str, whole: Path, trials: Trials, tmp_path: Path) -> None:
    """The process starts as for a user; the moments are counted from the first line of the package's own code."""
    trials.only_in_a_campaign()
    folder = fresh(tmp_path / "work", whole, name)
    seconds, _ = interrupted(name, folder, None, 0.0)
    shutil.copy(folder / OUTPUTS[name], whole)
    shutil.rmtree(folder)
    codes = []
    for random in trials.rounds(2, 100):
        folder = fresh(tmp_path / "work", whole, name)
        _, done = interrupted(name, folder, random.choice(SIGNALS), random.uniform(0, 1.05 * seconds))
        check(name, done, folder, whole)
        codes.append(done.code)
    print(f"{name}: {codes.count(0)} complete, {codes.count(130)} interrupted in {seconds:.1f} s")


def interrupted(name: str, folder: Path, number: np.int64 | None, delay: float) -> tuple[float, Done]:
    """Start a command, send a signal after a delay [s], and return the time that the process took, and its end."""
    code = (
        "import os, sys; from octoreplay import __main__, interrupts; interrupts.install(); os.write(1, b'.');"
        " sys.argv[0] = 'octoreplay'; __main__.main()"
    )
    with (folder.parent / "stderr").open("w+") as errors:
        process = subprocess.Popen(
            [sys.executable, "-c", code, *map(str, COMMANDS[name])], cwd=folder, stdout=subprocess.PIPE, stderr=errors,
            env={**os.environ, "COLUMNS": "100"}, start_new_session=True,
        )  # fmt: skip
        assert process.stdout is not None
        process.stdout.read(1)
        started = time.monotonic()
        if number is not None:
            time.sleep(delay)
            process.send_signal(int(number))
        out, _ = process.communicate(timeout=120)
        errors.seek(0)
        return time.monotonic() - started, Done(process.returncode, out.decode(), errors.read(), 0)


LONG_RUN = (
    "run", PAIR_TEAM, "--rule", "gradient", "--settle", "60", "--settle-max", "60", "--state-every", "0.001",
    "-o", "x.mcap",
)  # fmt: skip
"""Arguments of a run whose result has many chunks."""


def test_a_killed_run_leaves_the_old_output_and_every_chunk(server: ForkServer, trials: Trials, tmp_path: Path) -> None:
    trials.only_in_a_campaign()
    whole = tmp_path / "whole"
    whole.mkdir()
    started = time.monotonic()
    assert server.run(*LONG_RUN, folder=whole).code == 0
    seconds = time.monotonic() - started
    num_partial = 0
    for random in trials.rounds(2, 100):
        folder = fresh(tmp_path / "work", whole, "run")
        child = server.start(*LONG_RUN, folder=folder)
        time.sleep(random.uniform(0.2, 1.0) * seconds)
        os.kill(child.pid, signal.SIGKILL)
        done = child.wait()
        partial = folder / "x.partial.mcap"
        new = (whole / "x.mcap").read_bytes()
        assert (folder / "x.mcap").read_bytes() in ((b"old", new) if not partial.exists() else (b"old",))
        if partial.exists() and has_messages(partial):
            num_partial += 1
            check_partial(partial, whole / "x.mcap")
            recovery = server.run("recover", partial.name, folder=folder)
            if partial.read_bytes() == new:
                # Killed between the last write and the renaming.
                assert "only its name is missing; rename it to x.mcap" in recovery.err
            else:
                assert recovery.code == 0, recovery
                check_partial(folder / "x.recovered.mcap", whole / "x.mcap")
            before = partial.read_bytes()
            again = server.run(*LONG_RUN, folder=folder)
            assert again.code == 1
            assert "left this unfinished result; continue it with --resume" in again.err
            assert partial.read_bytes() == before
        assert done.code in (0, -signal.SIGKILL)
        shutil.rmtree(folder)
    print(f"{num_partial} partial results")


def test_two_signals_end_the_process_at_once(whole: Path, server: ForkServer, trials: Trials, tmp_path: Path) -> None:
    trials.only_in_a_campaign()
    for random in trials.rounds(2, 60):
        folder = fresh(tmp_path / "work", whole, "run")
        child = server.start(*QUICK_RUN, folder=folder)
        time.sleep(random.uniform(0, 1.0))
        for _ in range(2):
            os.kill(child.pid, signal.SIGINT)
            time.sleep(random.uniform(0, 0.02))
        done = child.wait()
        assert done.code in (0, 130), done
        assert "Traceback" not in done.err
        left = (folder / "x.mcap").read_bytes()
        assert left == ((whole / "x.mcap").read_bytes() if done.code == 0 else b"old")
        shutil.rmtree(folder)
