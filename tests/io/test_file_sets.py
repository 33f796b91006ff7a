"""Files that belong together."""

from __future__ import annotations

from pathlib import Path

import pytest

from octoreplay.errors import OutputError
from octoreplay.io.file_sets import write_together


def test_all_files_are_written(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"before")
    write_together({tmp_path / "a": [b"1"], tmp_path / "b": []})
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {"a": b"1", "b": b""}


def test_a_failed_write_leaves_no_file(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"before")
    with pytest.raises(OutputError, match=r"none/b: cannot be written: No such file"):
        write_together({tmp_path / "a": [b"1"], tmp_path / "none" / "b": [b"2"]})
    (tmp_path / "folder").mkdir()
    with pytest.raises(OutputError, match=r"folder: cannot be written"):
        write_together({tmp_path / "folder": [b"1"]})
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "folder"]
    assert (tmp_path / "a").read_bytes() == b"before"
