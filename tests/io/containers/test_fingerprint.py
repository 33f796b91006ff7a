import hashlib
from pathlib import Path

import pytest

from octoreplay.errors import InputError
from octoreplay.io.containers.fingerprint import EDGE, fingerprint, log_files
from octoreplay.io.containers.mcap_writer import RosMcapWriter
from octoreplay.io.messages.ros_types import message, time_message


def write_mcap(path: Path, number: int) -> None:
    with RosMcapWriter(path) as writer:
        for index in range(3):
            clock = message("rosgraph_msgs/msg/Clock", clock=time_message(index + number))
            writer.write("/clock", "rosgraph_msgs/msg/Clock", clock, index + number)


def test_the_fingerprint_of_a_finished_mcap_is_of_its_summary_and_footer(tmp_path: Path) -> None:
    write_mcap(tmp_path / "a.mcap", 1)
    write_mcap(tmp_path / "same.mcap", 1)
    write_mcap(tmp_path / "other.mcap", 2)
    first = fingerprint(tmp_path / "a.mcap")
    assert first.method == "mcap-summary"
    assert first.size == (tmp_path / "a.mcap").stat().st_size
    assert fingerprint(tmp_path / "same.mcap").value == first.value
    assert fingerprint(tmp_path / "other.mcap").value != first.value
    data = (tmp_path / "a.mcap").read_bytes()
    start = int.from_bytes(data[-37 + 9 :][:8], "little")
    assert first.value == hashlib.sha256(data[start:]).hexdigest()


@pytest.mark.parametrize("cut", [1, 8, 20, 37, 60])
def test_the_fingerprint_of_a_cut_mcap_is_of_its_first_and_last_mib(tmp_path: Path, cut: int) -> None:
    path = tmp_path / "a.mcap"
    write_mcap(path, 1)
    path.write_bytes(path.read_bytes()[:-cut])
    assert fingerprint(path).method == "edges"


@pytest.mark.parametrize("size", [0, 1, EDGE, EDGE + 5, 2 * EDGE, 2 * EDGE + 5])
def test_overlapping_ends_are_hashed_once(tmp_path: Path, size: int) -> None:
    data = bytearray(index % 251 for index in range(size))
    path = tmp_path / "a.bag"
    path.write_bytes(data)
    whole = bytes(data) if size <= 2 * EDGE else bytes(data[:EDGE] + data[-EDGE:])
    assert fingerprint(path).value == hashlib.sha256(whole).hexdigest()


def test_only_the_whole_hash_covers_the_middle(tmp_path: Path) -> None:
    data = bytearray(2 * EDGE + 100)
    path = tmp_path / "a.bag"
    path.write_bytes(data)
    quick, whole = fingerprint(path), fingerprint(path, whole=True)
    data[EDGE + 50] = 1
    path.write_bytes(data)
    assert fingerprint(path) == quick
    changed = fingerprint(path, whole=True)
    assert changed != whole
    assert changed.value == hashlib.sha256(data).hexdigest()
    assert changed.method == "sha256"


def test_a_missing_file_is_an_input_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.mcap: cannot be read: No such file"):
        fingerprint(tmp_path / "none.mcap")


def test_the_files_of_a_folder_are_sorted(tmp_path: Path) -> None:
    for name in ("b.db3", "a.db3", "metadata.yaml"):
        (tmp_path / name).write_text(name)
    assert [path.name for path in log_files(tmp_path)] == ["a.db3", "b.db3", "metadata.yaml"]
    assert log_files(tmp_path / "a.db3") == (tmp_path / "a.db3",)
