"""Output of the commands: JSON, --quiet, --verbose, colours, and warnings at the end."""

from __future__ import annotations

import json
import logging
import re
import shutil
from pathlib import Path
from typing import Any

import click
import pytest

from octoreplay import cli
from octoreplay.commands.console import prints, terminal
from octoreplay.errors import EARLY
from octoreplay.result import open_result
from support.command_line import assert_fails, octoreplay, octoreplay_process
from support.fixture_paths import PAIR, PAIR_TEAM, TRIO


def commands() -> dict[str, click.Command]:
    """Return every command by its words."""
    found: dict[str, click.Command] = {}
    for name, command in cli.cli.commands.items():
        parts = command.commands if isinstance(command, click.Group) else {"": command}
        found |= {f"{name} {part}".strip(): one for part, one in parts.items()}
    return found


@pytest.mark.parametrize("name", commands())
def test_every_command_has_the_options_of_the_output(name: str) -> None:
    options = {option for parameter in commands()[name].params for option in parameter.opts}
    assert {"--json", "-q", "--quiet", "-v", "--verbose"} <= options


def without_constants(text: str) -> Any:
    """Return a JSON document; NaN and infinities raise."""

    def refuse(name: str) -> None:
        raise AssertionError(name)

    return json.loads(text, parse_constant=refuse)


def test_the_document_of_metrics_is_the_summary(pair_result: Path) -> None:
    done = octoreplay("metrics", pair_result, "--json")
    document = without_constants(done.stdout)
    assert list(document) == ["command", "result", "verdict", "summary", "written", "warnings"]
    with open_result(pair_result) as opened:
        summary = opened.summary
    assert document["summary"]["total_sent_bytes"] == summary.total_sent_bytes
    assert document["summary"]["wall_seconds"] is None
    assert [robot["robot_id"] for robot in document["summary"]["last"]["robots"]] == ["husky_1", "husky_2"]
    assert document["verdict"]["has_agreed"] is True
    assert document["verdict"]["sent_bytes_per_second"] == summary.log_sent_bytes / 2 / summary.log_seconds
    assert "agreement, worst robot" in done.stderr
    quiet = octoreplay("metrics", pair_result, "--json", "--quiet")
    assert (quiet.stdout, quiet.stderr) == (done.stdout, "")


def test_quiet_prints_no_tables_and_verbose_all_rows(pair_result: Path) -> None:
    assert octoreplay("metrics", pair_result, "-q").stdout == ""
    assert "husky_2   " not in octoreplay("metrics", pair_result).stdout
    done = octoreplay("metrics", pair_result, "-v")
    assert re.search("^husky_2   ", done.stdout, re.M)
    assert re.fullmatch(r"took [0-9.]+ s\n", done.stderr)
    assert_fails(2, "--quiet and --verbose exclude each other", "metrics", pair_result, "-q", "-v")


def test_an_error_leaves_no_document(tmp_path: Path) -> None:
    done = octoreplay("metrics", tmp_path / "none.mcap", "--json")
    assert (done.returncode, done.stdout) == (1, "")


def test_warnings_come_once_and_at_the_end(tmp_path: Path) -> None:
    shutil.copytree(PAIR, tmp_path, dirs_exist_ok=True)
    log = tmp_path / "husky_2.mcap"
    log.write_bytes(log.read_bytes()[: int(log.stat().st_size * 0.7)])
    words = ("run", tmp_path / "team.yaml", "-o", tmp_path / "out.mcap", "--settle", 0, "--resolution", 0.8)
    done = octoreplay(*words, "--json", "-q")
    document = without_constants(done.stdout)
    assert done.returncode == 3
    printed = [line.removeprefix("warning: ") for line in done.stderr.splitlines() if line.startswith("warning: ")]
    assert printed == document["warnings"]
    assert len(set(printed)) == len(printed) > 0
    stored = octoreplay("metrics", tmp_path / "out.mcap")
    assert f"warnings  {len(printed)}, at the end, with remedies" in stored.stdout
    assert stored.stderr.count("warning: ") == len(printed)


def test_early_warnings_are_printed_at_once_and_once(monkeypatch: pytest.MonkeyPatch) -> None:
    log = logging.getLogger("octoreplay.replay")

    @click.command()
    @prints
    def probe() -> int:
        log.warning("warning: %s", "late")
        log.warning("warning: %s", "early", extra=EARLY)
        terminal().note("in the middle")
        log.warning("warning: %s", "late")
        terminal().give()
        return 0

    monkeypatch.setitem(cli.cli.commands, "probe", probe)
    done = octoreplay("probe", "--json")
    assert json.loads(done.stdout)["warnings"] == ["late", "early"]
    assert done.stderr.splitlines() == ["warning: early", "in the middle", "warning: late"]


def test_colours_follow_the_environment(pair_result: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = ("check", pair_result, "--max-packet-bytes", 1)
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setenv("TERM", "xterm")
    red = re.compile("\x1b\\[[0-9;]*31m")
    assert red.search(octoreplay(*words).stdout)
    monkeypatch.setenv("NO_COLOR", "1")
    done = octoreplay(*words)
    assert not red.search(done.stdout)
    assert "FAILED" in done.stdout


@pytest.mark.long
def test_stdout_of_every_command_is_one_document(pair_result: Path, tmp_path: Path) -> None:
    shutil.copy(pair_result, tmp_path / "r.mcap")
    result, log = tmp_path / "r.mcap", PAIR / "husky_1.mcap"
    keys = {
        ("run", PAIR_TEAM, "-o", tmp_path / "x.mcap"): {"result", "team_file", "verdict", "summary"},
        ("run", log, "--save-team", tmp_path / "t.yaml"): {"team_file"},
        ("metrics", result, "--csv", tmp_path / "m.csv"): {"result", "verdict", "summary", "written"},
        ("info", log): {"logs", "robots", "overlap_ns", "class_table", "missing"},
        ("init", log, "-o", tmp_path / "team.yaml"): {"team_file", "robots", "missing"},
        ("query", result, "--point", 1, 0, 0): {"result", "points", "box", "robot_id", "seconds", "map", "frame_id"},
        ("check", result, "--min-agreement", 2 / 3): {"result", "passed", "rows"},
        ("compare", result, result): {"is_same", "maps", "settings"},
        ("evaluate", result, "--last", "--truth", TRIO / "world.npz"): {"ticks", "class_names", "written"},
        ("export", result, "-o", tmp_path / "map.ply"): {"result", "written", "counts"},
        ("simulate", tmp_path / "village", "--robots", 1, "--duration", 1, "--world-size", 20): {"team_file"},
    }
    for words, expected in keys.items():
        done = octoreplay_process(*words, "--json")
        assert done.stdout, done.stderr
        document = without_constants(done.stdout)
        assert expected <= document.keys(), words
        assert document["command"] == words[0]
        assert isinstance(document["warnings"], list)
