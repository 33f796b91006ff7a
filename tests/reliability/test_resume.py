"""Runs that are killed at random moments, or lose what was not synced, continue and end with the same bytes."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from pathlib import Path

import numpy as np

from octoreplay.config.team_file import load_team_file
from octoreplay.io.output_file import OutputFile
from octoreplay.replay.run import replay_team
from support.command_line import ENVIRONMENT, command
from support.fixture_paths import TRIO_TEAM
from support.interrupted import interrupted_after
from support.long_suite import long
from support.trials import Trials


@long
def test_killed_runs_end_with_the_same_bytes(tmp_path: Path, trials: Trials) -> None:
    """Every trial kills one run; a run that ends before begins anew."""
    whole, output = tmp_path / "whole.mcap", tmp_path / "out.mcap"
    words = command("run", TRIO_TEAM, "--state-every", "1", "--checkpoint-every", "0.1")
    environment = {**os.environ, **ENVIRONMENT}
    started = time.monotonic()
    subprocess.run([*words, "-o", str(whole)], check=True, env=environment, capture_output=True)
    seconds = time.monotonic() - started

    def resume(limit: float | None) -> bool:
        """True where a resumed run ends within a limit, after which it is killed."""
        process = subprocess.Popen(
            [*words, "-o", str(output), "--resume"], env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
        try:
            _, errors = process.communicate(timeout=limit)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            process.communicate()
            ended = False
        else:
            assert process.returncode == 0, errors.decode()
            ended = True
        # A kill between the last rename and the exit leaves the whole result.
        if ended or output.exists():
            assert output.read_bytes() == whole.read_bytes()
            output.unlink()
        return ended

    num_kills = 0
    for random in trials.rounds(few=4, most=10_000):
        num_kills += not resume(random.uniform(0.1, 1.0) * seconds)
        if num_kills == 100:
            break
    resume(None)
    print(f"{num_kills} kills")


@long
def test_what_was_not_synced_is_not_needed(tmp_path: Path, monkeypatch) -> None:
    """A power cut keeps what was synced; of the rest it may keep any block."""
    config = load_team_file(TRIO_TEAM).with_parameters({"state_every": 1.0})
    output, partial = tmp_path / "out.mcap", tmp_path / "out.partial.mcap"
    replay_team(config, tmp_path / "whole.mcap")
    sizes = []
    with monkeypatch.context() as patched:
        sync = OutputFile.sync
        patched.setattr(OutputFile, "sync", lambda file: (sync(file), sizes.append(file.tell())))
        interrupted_after(3, config, output)
    data = bytearray(partial.read_bytes())
    assert len(data) > max(sizes)
    data[max(sizes) :] = np.random.default_rng(0).bytes(len(data) - max(sizes))
    partial.write_bytes(data)
    replay_team(config, output, resume=True)
    assert output.read_bytes() == (tmp_path / "whole.mcap").read_bytes()
