"""List of the files of a result in tiles."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from octoreplay.errors import InputError
from octoreplay.io.results.tile_files import TileFile, TileList, maps_folder, put_file, remove_others

FILE = TileFile(-1, 2, "a.maps/tile_-1_2-0123456789abcdef.mcap", 10, "f0")


def test_a_list_is_read_as_it_was_written() -> None:
    tiles = TileList(32, (FILE, dataclasses.replace(FILE, x=4)))
    assert TileList.of(tiles.values()) == tiles


@pytest.mark.parametrize(
    ("num_cells", "file"), [(32, "../b.mcap"), (32, "/a/b.mcap"), (32, "a/b/c.mcap"), (33, FILE.file), (0, FILE.file)]
)
def test_files_elsewhere_and_other_edges_are_refused(num_cells: int, file: str) -> None:
    with pytest.raises(ValueError, match=r"leaves the folder|no power of two"):
        TileList.of(TileList(num_cells, (dataclasses.replace(FILE, file=file),)).values())


def test_files_are_put_checked_and_removed(tmp_path: Path) -> None:
    result, kept = tmp_path / "a.mcap", []
    for number in range(2):
        (tmp_path / "new").write_bytes(bytes([number]))
        kept.append(put_file(tmp_path / "new", result, number, 0))
    paths = [file.checked_path(result) for file in kept]
    assert [path.read_bytes() for path in paths] == [b"\x00", b"\x01"]
    remove_others(result, kept[1:])
    assert list(maps_folder(result).iterdir()) == paths[1:]
    paths[1].write_bytes(b"\x02")
    with pytest.raises(InputError, match=r"is damaged, or not the file that a\.mcap was written"):
        kept[1].checked_path(result)
    remove_others(result, ())
    assert not maps_folder(result).exists()
