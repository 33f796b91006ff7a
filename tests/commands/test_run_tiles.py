"""``octoreplay run --tiles``: as a process, killed, continued and refused."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import subprocess
from pathlib import Path

import pytest

from octoreplay.io.results.result_reader import ResultReader
from support.command_line import command, octoreplay, octoreplay_process, started, wait_for
from support.fixture_paths import TRIO, TRIO_TEAM
from support.long_suite import long

EDGE = "9.6"


def workers_of(pid: int) -> list[int]:
    """Worker processes of a run."""
    found = []
    for folder in Path("/proc").iterdir():
        if folder.name.isdecimal():
            try:
                words = (folder / "cmdline").read_bytes()
                parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
            except (OSError, IndexError):
                continue
            if parent == pid and b"import serve" in words:
                found.append(int(folder.name))
    return found


@long
def test_a_run_in_tiles_equals_the_whole_run(tmp_path: Path) -> None:
    done = octoreplay_process("run", TRIO_TEAM, "-o", tmp_path / "tiled.mcap", "--tiles", EDGE, "--jobs", 2)
    assert done.returncode == 0, done.stderr
    assert octoreplay("run", TRIO_TEAM, "-o", tmp_path / "whole.mcap", "-q").returncode == 0
    done = octoreplay("compare", tmp_path / "whole.mcap", tmp_path / "tiled.mcap", "--tolerance", "0")
    assert done.returncode == 0
    assert "the same: all cells of 4 maps" in done.stdout


@long
def test_killed_workers_are_started_again(tmp_path: Path) -> None:
    arguments = ("run", TRIO_TEAM, "-q", "--tiles", EDGE, "-o")
    assert octoreplay(*arguments, tmp_path / "whole.mcap").returncode == 0
    with started(*arguments, tmp_path / "killed.mcap") as process:
        for _ in range(2):
            wait_for(lambda: workers_of(process.pid))
            (worker,) = workers_of(process.pid)
            os.kill(worker, signal.SIGKILL)
            wait_for(lambda worker=worker: worker not in workers_of(process.pid))
        _, errors = process.communicate(timeout=200)
    assert process.returncode == 0
    assert "its process was killed by signal 9; it is started again" in errors
    assert (tmp_path / "killed.mcap").read_bytes() == (tmp_path / "whole.mcap").read_bytes()


def num_settled(folder: Path) -> int:
    """Number of tiles that have settled."""
    number = 0
    for path in folder.glob("tile_*.json"):
        # A tile that is saved again has no file for a moment.
        with contextlib.suppress(OSError):
            number += '"stop_reason": ""' not in path.read_text()
    return number


@long
@pytest.mark.parametrize("is_settling", [False, True])
def test_a_killed_run_continues(tmp_path: Path, is_settling) -> None:
    arguments = ("run", TRIO_TEAM, "-q", "--tiles", EDGE, "-o")
    assert octoreplay(*arguments, tmp_path / "whole.mcap").returncode == 0
    output, folder = tmp_path / "out.mcap", tmp_path / "out.tiles"
    with started(*arguments, output) as process:
        wait_for(lambda: (num_settled(folder) if is_settling else len(list(folder.glob("tile_*.json")))) >= 2)
        process.kill()
        process.wait()
    wait_for(lambda: not workers_of(process.pid))
    done = octoreplay(*arguments, output)
    assert done.returncode == 1
    assert "an earlier run left these tiles; continue it with --resume" in done.stderr
    done = octoreplay("run", TRIO_TEAM, "-q", "--tiles", 2 * float(EDGE), "--resume", "-o", output)
    assert done.returncode == 2
    assert "the tiles had another form; use the same --tiles and --tiles-z" in done.stderr
    done = octoreplay(*arguments, output, "--resume", "--rule", "gradient")
    assert done.returncode == 2
    assert "cannot be continued: 'gradient' was 'bayes'" in done.stderr
    done = octoreplay(*arguments, output, "--resume")
    assert done.returncode == 0, done.stderr
    assert output.read_bytes() == (tmp_path / "whole.mcap").read_bytes()
    assert not folder.exists()


@long
def test_a_worker_that_cannot_write_ends_the_run_with_one_sentence(tmp_path: Path) -> None:
    arguments = ("run", TRIO_TEAM, "-q", "--tiles", EDGE, "-o", tmp_path / "out.mcap")
    # Files of more than 100 KiB fail, as on a full disk: those with the maps of a tile, not those with its scans.
    words = ["bash", "-c", 'ulimit -f 100 && exec "$0" "$@"', *command(*arguments)]
    done = subprocess.run(words, text=True, capture_output=True, check=False, timeout=200)
    assert done.returncode == 1
    *_, sentence = done.stderr.strip().splitlines()
    assert re.fullmatch(
        r"error: .*/out\.tiles/tile_\S+: cannot be written: File too large; the finished parts are in .*/out\.tiles;"
        r" --resume continues the run",
        sentence,
    )
    assert not (tmp_path / "out.mcap").exists()
    assert octoreplay(*arguments, "--resume").returncode == 0
    assert octoreplay(*arguments[:-1], tmp_path / "whole.mcap").returncode == 0
    assert (tmp_path / "out.mcap").read_bytes() == (tmp_path / "whole.mcap").read_bytes()


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--tiles", "5"], "tiles: an edge of 5 m is about 16 cells of 0.3 m; give at least 9.6 m, 32 cells"),
        (["--tiles", "-1"], "tiles: -1 m is no edge of a tile; give metres above 0"),
        (["--tiles", "20", "--rate", "1000"], "tiles: cannot be used with rate"),
        (["--tiles", "20", "--budget", "20000"], "tiles: cannot be used with budget"),
        (["--tiles", "20", "--align", "on-air"], "tiles: cannot be used with align on-air"),
        (["--tiles", "20", "--prune-tolerance", "0.1"], "tiles: cannot be used with prune_tolerance"),
        (["--tiles", "20", "--keep-packets"], "tiles: cannot be used with keep_packets"),
        (["--tiles", "20", "--rule", "flood", "--loss", "0.1"], "tiles: cannot be used with rule flood with losses"),
        (["--tiles", "20", "--rule", "latest", "--loss", "0.1"], "tiles: cannot be used with rule latest with losses"),
        (["--tiles", "20", "--bounds", "500,500,0,600,600,10"], "bounds: no ray of any frame passes them"),
    ],
)
def test_what_tiles_cannot_do_is_one_sentence(tmp_path: Path, options, sentence) -> None:
    done = octoreplay("run", TRIO_TEAM, "-q", "-o", tmp_path / "out.mcap", *options)
    assert done.returncode == (1 if "bounds" in sentence else 2)
    assert sentence in " ".join(done.stderr.split())
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "options",
    [
        ["--jobs", "2"],
        ["--scheduler", "tcp://127.0.0.1:1"],
        ["--tiles-z"],
        ["--result-per-tile"],
        ["--tiles", "20", "--checkpoint-every", "1"],
    ],
)
def test_options_that_do_not_go_together(tmp_path: Path, options) -> None:
    assert octoreplay("run", TRIO_TEAM, "-o", tmp_path / "out.mcap", *options).returncode == 2
    assert list(tmp_path.iterdir()) == []


@long
def test_a_log_that_is_cut_gives_what_the_whole_run_gives(tmp_path: Path) -> None:
    for path in TRIO.iterdir():
        shutil.copy(path, tmp_path)
    (log, *_) = sorted(tmp_path.glob("*.mcap"))
    log.write_bytes(log.read_bytes()[: log.stat().st_size * 2 // 3])
    outputs = [tmp_path / "whole.result.mcap", tmp_path / "tiled.result.mcap"]
    for output, options in zip(outputs, ([], ["--tiles", EDGE]), strict=True):
        assert octoreplay("run", tmp_path / "team.yaml", "-q", "-o", output, *options).returncode == 3
    with ResultReader(outputs[0]) as one, ResultReader(outputs[1]) as other:
        whole, tiled = one.summary(one.metrics()), other.summary(other.metrics())
        assert (whole.frame_counts, whole.warnings) == (tiled.frame_counts, tiled.warnings)
