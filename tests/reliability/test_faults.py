"""Each writing operation fails once, and from then on: the old file, a complete new one or a valid partial is left."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from octoreplay.io.results.unfinished import has_messages
from support.fixture_paths import PAIR, PAIR_TEAM
from support.forked import ForkServer
from support.long_suite import long
from support.outcomes import QUICK_RUN, check_partial, content, one_sentence
from support.trials import Trials

COMMANDS = {
    "run": QUICK_RUN,
    "save-team": ("run", PAIR_TEAM, "--save-team", "t.yaml"),
    "metrics": ("metrics", "r.mcap", "--csv", "m.csv"),
    "figures": ("metrics", "r.mcap", "--csv", "m.csv", "--plot", "figures"),
    "export": ("export", "r.mcap", "-o", "m.ply"),
    "recover": ("recover", "r.partial.mcap", "-o", "c.mcap"),
    "evaluate": ("evaluate", "r.mcap", "--csv", "e.csv"),
    "init": ("init", PAIR / "husky_1.mcap", "-o", "t.yaml"),
    "align": ("align", "r.mcap", "-o", "a.yaml", "--csv", "a.csv"),
    "simulate": ("simulate", "team", "--robots", "1", "--duration", "1", "--image", "16x12", "--world-size", "20"),
}


@long
@pytest.mark.parametrize("stays", [False, True], ids=["once", "from then on"])
@pytest.mark.parametrize("name", COMMANDS)
def test_a_failed_operation_leaves_the_old_or_the_new_files(
    name: str, stays: bool, results: Path, server: ForkServer, trials: Trials, tmp_path: Path
) -> None:
    trials.only_in_a_campaign(unless=name == "run" and not stays)
    arguments = COMMANDS[name]
    whole = tmp_path / "whole"
    shutil.copytree(results, whole)
    before = content(whole)
    count = server.run(*arguments, folder=whole, fails_at=0)
    assert count.code in ((0, 1) if name == "align" else (0,)), count.err
    after = content(whole)
    made = [path for path in after if path not in before]
    numbers = np.random.default_rng(trials.seed).permutation(count.count) + 1
    for number, _ in zip(numbers, trials.rounds(2, count.count), strict=False):
        folder = tmp_path / "work"
        shutil.copytree(results, folder)
        old = dict(before)
        if name != "simulate":
            for path in made:
                (folder / path).parent.mkdir(exist_ok=True)
                (folder / path).write_bytes(b"old")
                old[path] = b"old"
        done = server.run(*arguments, *_force(name), folder=folder, fails_at=int(number), stays=stays)
        one_sentence(done)
        left = content(folder)
        partial = left.pop("x.partial.mcap", None)
        if partial is not None and has_messages(folder / "x.partial.mcap"):
            assert "the finished part is in x.partial.mcap" in done.err
            check_partial(folder / "x.partial.mcap", whole / "x.mcap")
        # A folder or file that cannot be removed stays under a hidden name.
        left = {path: data for path, data in left.items() if not any(part[0] == "." for part in Path(path).parts)}
        assert left.keys() <= old.keys() | after.keys()
        assert all(data in (old.get(path), after.get(path)) for path, data in left.items()), (number, done)
        assert old.keys() <= left.keys()
        assert done.code == count.code or done.code == 1
        if done.code == 0:
            assert left == after
        shutil.rmtree(folder)


def _force(name: str) -> tuple[str, ...]:
    return () if name == "simulate" else ("--force",)


@pytest.mark.parametrize("limit", ["RLIMIT_FSIZE", "RLIMIT_AS"])
def test_limits_of_the_system_leave_the_old_or_the_new_result(
    limit: str, results: Path, server: ForkServer, trials: Trials, tmp_path: Path
) -> None:
    trials.only_in_a_campaign(unless=limit == "RLIMIT_FSIZE")
    new = (results / "r.mcap").read_bytes()
    for random in trials.rounds(1, 60):
        folder = tmp_path / "work"
        folder.mkdir()
        (folder / "x.mcap").write_bytes(b"old")
        size = int(random.integers(300, 20_000)) if limit == "RLIMIT_FSIZE" else int(random.integers(1200, 3000)) << 20
        done = server.run(*QUICK_RUN, folder=folder, limits={limit: size})
        one_sentence(done)
        left = content(folder)
        assert left["x.mcap"] == (new if done.code == 0 else b"old"), done
        assert done.code in (0, 1)
        if "x.partial.mcap" in left:
            check_partial(folder / "x.partial.mcap", results / "r.mcap")
        shutil.rmtree(folder)


def test_memory_that_ends_in_the_middle_leaves_a_partial(
    results: Path, server: ForkServer, trials: Trials, tmp_path: Path
) -> None:
    trials.only_in_a_campaign()
    count = server.run(*QUICK_RUN, folder=tmp_path, calls_until=0).count
    new = (tmp_path / "x.mcap").read_bytes()
    for random in trials.rounds(2, 300):
        folder = tmp_path / "work"
        folder.mkdir()
        (folder / "x.mcap").write_bytes(b"old")
        done = server.run(*QUICK_RUN, folder=folder, calls_until=int(random.integers(1, count)))
        left = content(folder)
        assert done.code in (0, 1), done
        assert "Traceback" not in done.err
        assert left.pop("x.mcap") in ((new,) if done.code == 0 else (new, b"old"))
        if left.pop("x.partial.mcap", None) is not None:
            check_partial(folder / "x.partial.mcap", tmp_path / "x.mcap")
        assert not left
        shutil.rmtree(folder)


def test_a_folder_that_is_removed_during_the_run_is_an_error(server: ForkServer, tmp_path: Path) -> None:
    folder = tmp_path / "work"
    folder.mkdir()
    child = server.start(*QUICK_RUN[:-1], folder / "x.mcap", folder=tmp_path)
    while not (folder / "x.partial.mcap").exists():
        pass
    shutil.rmtree(folder)
    done = child.wait()
    assert done.code == 1
    one_sentence(done)
    assert "cannot be written" in done.err or "was removed during the run" in done.err


def test_a_full_disk_leaves_the_old_or_the_new_result(
    results: Path, server: ForkServer, trials: Trials, tmp_path: Path
) -> None:
    trials.only_in_a_campaign()
    folder = tmp_path / "disk"
    folder.mkdir()
    new = (results / "r.mcap").read_bytes()
    for random in trials.rounds(2, 60):
        size = int(random.integers(4, 20)) << 12
        mount = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", folder]
        if subprocess.run(mount, check=False, capture_output=True).returncode:
            pytest.skip("no file system can be mounted here")
        try:
            (folder / "x.mcap").write_bytes(b"old")
            done = server.run(*QUICK_RUN, folder=folder)
            one_sentence(done)
            left = content(folder)
            assert left["x.mcap"] == (new if done.code == 0 else b"old"), done
            assert done.code in (0, 1)
            if "x.partial.mcap" in left:
                check_partial(folder / "x.partial.mcap", results / "r.mcap")
        finally:
            subprocess.run(["umount", folder], check=True)
