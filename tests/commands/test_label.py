"""The command label: its output, exit codes and what it leaves behind."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from support.colour_logs import CLASSES, coloured_robot
from support.command_line import assert_fails, octoreplay
from support.log_factory import robot_entries, write_mcap
from support.long_suite import long
from support.networks import nearest_color_network


@pytest.fixture
def room(tmp_path: Path) -> Path:
    """A folder with a log, a network and its classes."""
    nearest_color_network(tmp_path / "net.onnx")
    (tmp_path / "classes.yaml").write_text(CLASSES)
    write_mcap(tmp_path / "robot.mcap", coloured_robot())
    return tmp_path


def words(room: Path, *more: object) -> tuple[object, ...]:
    """Arguments of the command."""
    return (
        "label", room / "robot.mcap", "--model", room / "net.onnx", "--classes", room / "classes.yaml",
        "-o", room / "robot.labelled.mcap", *more,
    )  # fmt: skip


@long
def test_a_log_is_labelled_described_and_mapped(room: Path) -> None:
    done = octoreplay(*words(room))
    assert done.returncode == 0, done.stderr
    assert "6 of 6" in done.stdout
    assert "100.0%" in done.stdout
    done = octoreplay("init", room / "robot.labelled.mcap", "-o", room / "team.yaml")
    assert (done.returncode, done.stderr) == (0, "")
    done = octoreplay("run", room / "team.yaml", "-o", room / "result.mcap", "-q")
    assert (done.returncode, done.stderr) == (0, "")


def test_the_json_document_has_the_counts(room: Path) -> None:
    document = json.loads(octoreplay(*words(room, "--json")).stdout)
    (robot,) = document["robots"]
    assert (robot["robot_id"], robot["num_labelled"], robot["labelled"]) == ("robot", 6, 6 * 96)
    assert sum(robot["classes"].values()) == robot["labelled"]


def test_an_existing_output_is_kept_unless_forced(room: Path) -> None:
    assert octoreplay(*words(room)).returncode == 0
    assert_fails(1, "already exists.*--force", *words(room))
    assert octoreplay(*words(room, "--force")).returncode == 0


def test_labels_that_an_earlier_command_left_are_not_removed_unasked(room: Path) -> None:
    left = room / "robot.labelled.labels"
    left.write_bytes(b"")
    assert_fails(1, "left these finished labels; continue it with --resume, or begin anew with --restart", *words(room))
    assert octoreplay(*words(room, "--restart")).returncode == 0
    assert not left.exists()


@pytest.mark.parametrize(
    ("more", "code", "sentence"),
    [
        (("--resume", "--restart"), 2, "give one of them"),
        (("--label-offset", 5), 2, "the class table does not have 5"),
        (("--input-size", "big"), 2, "expects WIDTHxHEIGHT"),
        (("--mean", "1,2"), 2, "mean: expects 3 numbers"),
        (("--extrinsics", "1,2,3"), 2, "extrinsics: expects 7 numbers"),
        (("--extrinsics", "0,0,0,0,0,0,0"), 2, "a quaternion whose length is not 0"),
        (("--extrinsics", "0,0,nan,0,0,0,1"), 2, "expects finite numbers"),
        (("--extrinsics", "0,0,0,0,0,0,1", "--aligned"), 2, "give one of --aligned and --extrinsics"),
        (("--colour-intrinsics", "0,1,2,3"), 2, "fx and fy are above 0"),
        (("--model", "none.onnx"), 1, "none.onnx: no such file"),
        (("--classes", "none.yaml"), 2, "neither a file nor a built-in table"),
        (("--every", 0), 2, "every: 0"),
        (("-o", "x.bag"), 2, r"must end in \.mcap"),
    ],
)
def test_wrong_usage_is_refused_and_nothing_is_written(room: Path, more: tuple, code: int, sentence: str) -> None:
    before = set(room.iterdir())
    assert_fails(code, sentence, *words(room, *more))
    assert {path for path in set(room.iterdir()) - before if not path.name.startswith(".")} == set()


def test_a_name_that_is_too_long_for_a_file_beside_the_output_is_refused(room: Path) -> None:
    done = octoreplay(*words(room, "-o", room / f"{'x' * 250}.mcap"))
    assert done.returncode == 1
    assert "cannot be written" in done.stderr


def test_a_log_without_colour_and_a_missing_extra_are_refused(room: Path, monkeypatch) -> None:
    write_mcap(room / "robot.mcap", robot_entries())
    assert_fails(1, "has no colour images to label", *words(room))
    write_mcap(room / "robot.mcap", coloured_robot())
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    assert_fails(2, r"pip install 'octoreplay\[label\]'", *words(room))
