"""Import of folders of frames: order, robot names, and the range of times."""

from __future__ import annotations

from pathlib import Path

import pytest

from octoreplay.errors import InputError, OutputError
from octoreplay.io.datasets.frames_folder import frame_stamps, natural_order, robot_name
from octoreplay.io.output_file import unfinished


def test_numbers_in_names_sort_as_numbers():
    names = ["a10b2", "a10b10", "a9", "b1", "a010", "7", "10"]
    assert sorted(names, key=lambda name: natural_order(Path(name))) == [
        "7",
        "10",
        "a9",
        "a010",
        "a10b2",
        "a10b10",
        "b1",
    ]


@pytest.mark.parametrize(
    ("name", "expected"), [("left-arm.mcap", "left_arm"), ("00.mcap", "robot_00"), ("---.mcap", "robot")]
)
def test_a_robot_is_named_by_its_log(name, expected):
    assert robot_name(None, Path(name)) == expected


def test_times_are_limited_to_the_range_of_messages():
    last = 2**31 * 1_000_000_000 - 1
    assert frame_stamps(Path("a"), [0, last], None, 2) == [0, last]
    with pytest.raises(InputError, match=r"a: times must be below 2\^31 s"):
        frame_stamps(Path("a"), [0, last + 1], None, 2)


def test_a_log_appears_only_when_it_is_finished(tmp_path):
    output = tmp_path / "a.mcap"
    with unfinished(output) as partial:
        partial.write_bytes(b"whole")
        assert not output.exists()
    assert output.read_bytes() == b"whole"

    def fail(error: BaseException) -> None:
        with unfinished(output) as partial:
            partial.write_bytes(b"half")
            raise error

    with pytest.raises(KeyboardInterrupt):
        fail(KeyboardInterrupt())
    with pytest.raises(OutputError, match=r"a\.mcap: cannot be written: No space left"):
        fail(OSError(28, "No space left on device"))
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]
    assert output.read_bytes() == b"whole"
