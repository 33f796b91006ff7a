"""Two processes that write one output at different delays: one of them is refused, or both write it in turn."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from support.forked import ForkServer
from support.long_suite import long
from support.outcomes import QUICK_RUN, content, one_sentence
from support.trials import Trials

PAIRS = {
    "run": (QUICK_RUN, (*QUICK_RUN, "--resolution", "0.9")),
    "metrics": tuple(("metrics", f"{name}.mcap", "--csv", "m.csv", "--force") for name in "ab"),
    "export": tuple(("export", "a.mcap", "-o", "m.ply", "--what", what, "--force") for what in ("points", "voxels")),
    "figures": tuple(("metrics", f"{name}.mcap", "--plot", "figures", "--force") for name in "ab"),
}


@long
@pytest.mark.parametrize("name", PAIRS)
def test_two_processes_never_mix_in_one_output(name: str, server: ForkServer, trials: Trials, tmp_path: Path) -> None:
    trials.only_in_a_campaign(unless=name == "run")
    expected, seconds = [], []
    for arguments in PAIRS[name]:
        folder = tmp_path / f"alone-{len(expected)}"
        folder.mkdir()
        _results(server, folder, name, tmp_path)
        before, started = content(folder), time.monotonic()
        assert server.run(*arguments, folder=folder).code == 0
        seconds.append(time.monotonic() - started)
        expected.append({path: data for path, data in content(folder).items() if path not in before})
    refused = 0
    for number, random in enumerate(trials.rounds(1, 200)):
        folder = tmp_path / str(number)
        folder.mkdir()
        _results(server, folder, name, tmp_path)
        before = content(folder)
        first = server.start(*PAIRS[name][0], folder=folder)
        time.sleep(random.uniform(0, 0.8 * min(seconds)) if number else 0.0)
        second = server.start(*PAIRS[name][1], folder=folder)
        done = [first.wait(), second.wait()]
        for one in done:
            one_sentence(one)
            assert one.code in (0, 1)
            assert one.code == 0 or "is being written by process" in one.err, one
        found = {path: data for path, data in content(folder).items() if path not in before}
        winners = [index for index, one in enumerate(done) if one.code == 0]
        # Where both succeed, one of them began after the other had ended.
        assert winners
        assert found in [expected[index] for index in winners], (number, winners)
        assert not list(folder.rglob(".*"))
        refused += len(winners) == 1
    print(f"{name}: {refused} refused")


def _results(server: ForkServer, folder: Path, name: str, cache: Path) -> None:
    """Put the results that a command reads into a folder."""
    if name == "run":
        return
    for letter, arguments in zip("ab", PAIRS["run"], strict=True):
        path = cache / f"{letter}.mcap"
        if not path.exists():
            made = cache / letter
            made.mkdir()
            assert server.run(*arguments, folder=made).code == 0
            (made / "x.mcap").rename(path)
        (folder / path.name).write_bytes(path.read_bytes())
