"""The commands 'foxglove-layout', 'rviz-config' and 'rerun'."""

from __future__ import annotations

import json
import shlex
import sys
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from octoreplay.io.results.result_writer import partial_path
from support.command_line import assert_fails, octoreplay
from support.fixture_paths import FIXTURES
from support.long_suite import long
from support.result_factory import tick_metrics, write_killed, write_result, write_until

RESULT = FIXTURES / "result_3.mcap"


def test_layouts_of_foxglove_are_written_with_and_without_a_result(tmp_path: Path) -> None:
    for name, arguments in (("one.json", [RESULT]), ("team.json", [])):
        done = octoreplay("foxglove-layout", *arguments, "-o", tmp_path / name)
        assert (done.returncode, done.stderr) == (0, "")
        assert "Import from file" in done.stdout
        assert "/graph" in json.loads((tmp_path / name).read_text())["configById"]["3D!maps"]["topics"]


def test_rviz_gets_a_configuration_and_qos_profiles_and_the_commands_name_them(tmp_path: Path) -> None:
    view = tmp_path / "my view.rviz"
    done = octoreplay("rviz-config", RESULT, "-o", view)
    assert (done.returncode, done.stderr) == (0, "")
    start, play = (shlex.split(line) for line in done.stdout.splitlines()[1:])
    assert start[:3] == ["rviz2", "-d", str(view)]
    qos = Path(play[play.index("--qos-profile-overrides-path") + 1])
    assert play[-1] == str(RESULT)
    yaml = YAML(typ="safe", pure=True)
    assert "Visualization Manager" in yaml.load(view)
    assert "/tf_static" in yaml.load(qos)


def test_a_file_is_replaced_only_with_force(tmp_path: Path) -> None:
    (tmp_path / "view.qos.yaml").write_text("mine")
    for command, name in (("foxglove-layout", "layout.json"), ("rviz-config", "view.rviz")):
        (tmp_path / name).write_text("mine")
        assert_fails(1, "already exists; give another name, or use --force", command, RESULT, "-o", tmp_path / name)
        assert (tmp_path / name).read_text() == "mine"
        assert octoreplay(command, RESULT, "-o", tmp_path / name, "--force").returncode == 0
        assert (tmp_path / name).read_text() != "mine"


@pytest.mark.parametrize("command", ["foxglove-layout", "rviz-config"])
def test_refused_results_leave_no_file(command: str, tmp_path: Path) -> None:
    suffix = ".json" if command == "foxglove-layout" else ".rviz"
    folder = tmp_path / "out"
    folder.mkdir()
    out = folder / f"out{suffix}"
    killed = write_killed(tmp_path / "r.mcap", [])
    for code, sentence, result, output in (
        (1, "cannot be read", tmp_path / "none.mcap", out),
        (1, "no result of octoreplay", FIXTURES / "pair" / "husky_1.mcap", out),
        (1, "holds no tick", killed, out),
        (2, rf"must end in \{suffix}", RESULT, folder / "out.txt"),
        (1, "the folder '.*' does not exist", RESULT, folder / "none" / f"out{suffix}"),
    ):
        assert_fails(code, sentence, command, result, "-o", output)
    assert list(folder.iterdir()) == []


def test_the_result_of_an_interrupted_run_is_shown(tmp_path: Path) -> None:
    path = tmp_path / "result.mcap"
    with pytest.raises(RuntimeError):
        write_until(RuntimeError, path, [tick_metrics(1), tick_metrics(2)])
    for command, name in (("foxglove-layout", "out.json"), ("rviz-config", "out.rviz")):
        done = octoreplay(command, partial_path(path), "-o", tmp_path / name)
        assert done.returncode == 0
        assert "incomplete" in done.stderr


def test_the_logged_warning_of_an_interrupted_run_is_in_the_document_and_at_the_end(tmp_path: Path) -> None:
    path = tmp_path / "r\x1b.mcap"
    with pytest.raises(RuntimeError):
        write_until(RuntimeError, path, [tick_metrics(1)])
    done = octoreplay("foxglove-layout", partial_path(path), "-o", tmp_path / "out.json", "--json")
    (sentence,) = json.loads(done.stdout)["warnings"]
    assert "r\x1b.partial.mcap: incomplete: the run did not finish" in sentence
    *before, last = done.stderr.splitlines()
    assert before
    assert last == f"warning: {sentence}".replace("\x1b", r"\x1b")


def test_rerun_names_the_missing_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert_fails(2, r"use pip install 'octoreplay\[rerun\]'", "rerun", RESULT, "-o", tmp_path / "out.rrd")
    assert list(tmp_path.iterdir()) == []


@long
def test_rerun_writes_the_maps_of_the_chosen_robots(tmp_path: Path) -> None:
    out = tmp_path / "out.rrd"
    done = octoreplay("rerun", RESULT, "-o", out, "--robot", "central", "--every", "2")
    assert done.returncode == 0, done.stderr
    assert f"(6 maps, 11 ticks, {out.stat().st_size / 1000:.0f} kB)" in done.stdout
    assert_fails(1, "already exists", "rerun", RESULT, "-o", out)
    new = tmp_path / "new.rrd"
    assert_fails(1, "robot 'husky_9' not found", "rerun", RESULT, "-o", new, "--robot", "husky_9")
    assert_fails(1, "holds no map of any robot", "rerun", write_result(tmp_path), "-o", new)
    assert_fails(2, "-1", "rerun", RESULT, "-o", new, "--every", "-1")
    assert not new.exists()
