"""Run, interrupt, resume, restart, export, compare and recover on one folder, as a state machine.

The model is plain: the settings of the complete result, and the settings and last tick of the unfinished one.
"""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from typing import ClassVar

from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from octoreplay.config.resolved import ResolvedRun
from octoreplay.config.team_file import load_team_file
from octoreplay.errors import OctoreplayError
from octoreplay.io.robots.discover import resolve
from octoreplay.replay.run import Progress, replay_team
from octoreplay.result import open_result
from support.command_line import octoreplay
from support.fixture_paths import PAIR_TEAM
from support.long_suite import long
from support.machines import run_machine
from support.trials import Trials

SETTINGS = {
    "a": {"duration": 2.0, "settle": 3, "state_every": 1.0},
    "b": {"duration": 2.0, "settle": 3, "state_every": 1.0, "rule": "local"},
}
settings = st.sampled_from(sorted(SETTINGS))
modes = st.sampled_from(["plain", "restart", "resume"])


class RunMachine(RuleBasedStateMachine):
    """One output path, the runs into it, and the commands that read it."""

    ends: ClassVar[set[str]] = set()
    """Ways in which runs ended so far."""
    configs: ClassVar[dict[str, ResolvedRun]] = {}
    references: Path
    """Folder with an undisturbed result of each settings and its export; set before the machine runs."""

    def __init__(self) -> None:
        super().__init__()
        # Results hold relative paths of logs, so the folder is beside that of the references.
        self.folder = Path(tempfile.mkdtemp(dir=self.references.parent))
        self.path, self.partial_path = self.folder / "out.mcap", self.folder / "out.partial.mcap"
        self.output: str | None = None
        self.partial: tuple[str, int] | None = None

    @initialize(name=settings, stop=st.integers(0, 4))
    def begin(self, name: str, stop: int) -> None:
        """Begin with an interrupted run."""
        self.run(name, stop, "plain")

    @rule(name=settings, stop=st.sampled_from([None, None, None, 0, 1, 2, 3, 4]), mode=modes)
    def run(self, name: str, stop: int | None, mode: str) -> None:
        """Run with some settings; the run is interrupted after tick ``stop``, or ends (None)."""
        is_refused = self.partial is not None and (mode == "plain" or (mode == "resume" and self.partial[0] != name))
        first = self.partial[1] + 1 if self.partial is not None and mode == "resume" else 0
        ticks: list[int] = []

        def progress(now: Progress) -> None:
            ticks.append(now.tick)
            if now.tick == stop:
                raise KeyboardInterrupt

        config = self.configs[name]
        before = self.partial_path.read_bytes() if is_refused else b""
        try:
            options = {mode: True} if mode != "plain" else {}
            replay_team(config, self.path, progress=progress, num_threads=1, **options)
        except KeyboardInterrupt:
            assert not is_refused
            assert ticks == list(range(first, (stop or 0) + 1))
            self.partial = name, ticks[-1]
            self.ends.add("interrupted")
        except OctoreplayError:
            assert is_refused
            assert ticks == []
            assert self.partial_path.read_bytes() == before
            self.ends.add("refused")
        else:
            assert not is_refused
            # A run that was interrupted after its last tick has none left.
            assert ticks[:1] == [first] or (first > 0 and not ticks)
            self.output, self.partial = name, None
            self.ends.add("complete" if first == 0 else "resumed")

    @rule(name=settings)
    def compare(self, name: str) -> None:
        """Compare the result with an undisturbed one."""
        done = octoreplay("compare", self.path, self.references / f"{name}.mcap")
        assert done.returncode == (0 if self.output == name else 1), done.stdout + done.stderr

    @rule()
    def export(self) -> None:
        """Export the result; without one nothing is written."""
        ply = self.folder / "map.ply"
        done = octoreplay("export", self.path, "-o", ply)
        assert done.returncode == (0 if self.output else 1), done.stderr
        if self.output:
            assert ply.read_bytes() == (self.references / f"{self.output}.ply").read_bytes()
            ply.unlink()
        assert not ply.exists()

    @precondition(lambda self: self.partial is not None)
    @rule()
    def recover(self) -> None:
        """Copy what an interrupted run finished; the partial result stays."""
        recovered = self.folder / "recovered.mcap"
        done = octoreplay("recover", self.partial_path, "-o", recovered)
        assert done.returncode in (0, 3), done.stderr
        with open_result(recovered) as result:
            assert len(result.metrics) == self.partial[1] + 1
            assert not result.is_complete
        recovered.unlink()

    @invariant()
    def files_are_those_of_the_model(self) -> None:
        """The result has the bytes of an undisturbed run, and no file is left over."""
        expected = set()
        if self.output is not None:
            expected |= {"out.mcap"}
            assert self.path.read_bytes() == (self.references / f"{self.output}.mcap").read_bytes()
        if self.partial is not None:
            expected |= {"out.partial.mcap", "out.checkpoint"}
        assert {path.name for path in self.folder.iterdir()} == expected

    def teardown(self) -> None:
        shutil.rmtree(self.folder)


@long
def test_runs_on_one_folder_equal_their_model(tmp_path: Path, trials: Trials) -> None:
    RunMachine.references = tmp_path / "references"
    RunMachine.references.mkdir()
    for name, values in SETTINGS.items():
        RunMachine.configs[name] = resolve(load_team_file(PAIR_TEAM).with_parameters(values))
    for name, config in RunMachine.configs.items():
        result = RunMachine.references / f"{name}.mcap"
        replay_team(config, result, num_threads=1)
        assert octoreplay("export", result, "-o", result.with_suffix(".ply")).returncode == 0
    RunMachine.ends.clear()
    run_machine(RunMachine, trials, num_examples=5, num_steps=8)
    print("runs ended:", *sorted(RunMachine.ends))
    assert RunMachine.ends >= {"complete", "interrupted"}
