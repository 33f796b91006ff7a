"""Text files appear when they are whole, and records become JSON that any reader takes."""

import json
import math
from dataclasses import dataclass
from pathlib import Path

import pytest

from octoreplay.errors import OutputError
from octoreplay.io.text_files import json_text, write_whole


@dataclass(frozen=True)
class Inner:
    value: float
    where: Path


@dataclass(frozen=True)
class Outer:
    parts: tuple[Inner, ...]
    by_name: dict[str, float]


def test_a_file_replaces_the_one_before_it_and_leaves_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_text("before", encoding="utf-8")
    write_whole(path, "größer\n")
    assert path.read_bytes() == "größer\n".encode()
    assert list(tmp_path.iterdir()) == [path]


def test_what_cannot_be_written_is_one_sentence_and_keeps_what_was_there(tmp_path: Path) -> None:
    folder = tmp_path / "table.csv"
    folder.mkdir()
    with pytest.raises(OutputError, match=r"table\.csv: cannot be written: Is a directory"):
        write_whole(folder, "text")
    assert list(tmp_path.iterdir()) == [folder]
    with pytest.raises(OutputError, match=r"none/table\.csv: cannot be written: No such file"):
        write_whole(tmp_path / "none" / "table.csv", "text")


def test_records_become_json_without_numbers_that_json_lacks() -> None:
    text = json_text(Outer((Inner(math.nan, Path("a/b")), Inner(0.1, Path("c"))), {"é": -math.inf, "two": 2.0}))
    assert json.loads(text) == {
        "parts": [{"value": None, "where": "a/b"}, {"value": 0.1, "where": "c"}],
        "by_name": {"é": None, "two": 2.0},
    }
    assert "é" in text
    assert text.endswith("}\n")


def test_bytes_are_written_as_they_are(tmp_path: Path) -> None:
    write_whole(tmp_path / "a.png", b"\x89PNG\r\n\xff")
    assert (tmp_path / "a.png").read_bytes() == b"\x89PNG\r\n\xff"
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]
