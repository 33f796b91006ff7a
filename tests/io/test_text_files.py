"""Files are written atomically, and JSON of records is valid."""

import json
import math
from dataclasses import dataclass
from pathlib import Path

import pytest

from octoreplay.errors import OutputError
from octoreplay.io.output_file import write_whole
from octoreplay.io.text_files import json_text


@dataclass(frozen=True)
class Inner:
    value: float
    where: Path


@dataclass(frozen=True)
class Outer:
    parts: tuple[Inner, ...]
    by_name: dict[str, float]


def test_a_file_replaces_an_existing_one_and_leaves_no_other(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_text("before", encoding="utf-8")
    write_whole(path, "größer\n")
    assert path.read_bytes() == "größer\n".encode()
    assert list(tmp_path.iterdir()) == [path]


def test_a_failed_write_is_an_output_error_and_keeps_the_old_file(tmp_path: Path) -> None:
    folder = tmp_path / "table.csv"
    folder.mkdir()
    with pytest.raises(OutputError, match=r"table\.csv: cannot be written: Is a directory"):
        write_whole(folder, "text")
    assert list(tmp_path.iterdir()) == [folder]
    with pytest.raises(OutputError, match=r"none/table\.csv: cannot be written: No such file"):
        write_whole(tmp_path / "none" / "table.csv", "text")


def test_json_of_records_has_null_for_numbers_that_are_not_finite() -> None:
    text = json_text(Outer((Inner(math.nan, Path("a/b")), Inner(0.1, Path("c"))), {"é": -math.inf, "two": 2.0}))
    assert json.loads(text) == {
        "parts": [{"value": None, "where": "a/b"}, {"value": 0.1, "where": "c"}],
        "by_name": {"é": None, "two": 2.0},
    }
    assert "é" in text
    assert text.endswith("}\n")


def test_bytes_are_written_unchanged(tmp_path: Path) -> None:
    write_whole(tmp_path / "a.png", b"\x89PNG\r\n\xff")
    assert (tmp_path / "a.png").read_bytes() == b"\x89PNG\r\n\xff"
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]
