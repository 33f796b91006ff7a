"""Reader of PLY files against plyfile: random files in every form, and damaged ones."""

from __future__ import annotations

import random
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from plyfile import PlyData, PlyElement

from octoreplay.io.datasets.ply_format import PlyError, read_elements
from support.log_damage import MUTATIONS
from support.long_suite import examples

KINDS = ["i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"]
FORMS = [{"text": True}, {"byte_order": "<"}, {"byte_order": ">"}]


@st.composite
def elements(draw, name: str) -> PlyElement:
    """An element with numbers and lists of equal or different lengths."""
    rng = np.random.default_rng(draw(st.integers(0, 1 << 30)))
    num_rows, kinds = draw(st.integers(0, 5)), draw(st.lists(st.sampled_from(KINDS), min_size=1, max_size=4))
    num_lists = draw(st.integers(0, 2))
    names = [(f"p{i}", kind) for i, kind in enumerate(kinds)] + [(f"list{i}", "O") for i in range(num_lists)]
    rows = np.empty(num_rows, names)
    length = draw(st.none() | st.integers(0, 4))
    for field, kind in names:
        for index in range(num_rows):
            if kind == "O":
                size = int(rng.integers(0, 5)) if length is None else length
                rows[field][index] = rng.integers(-9, 9, size).astype(np.int32)
            else:
                rows[field][index] = rng.integers(0, 100)
    return PlyElement.describe(rows, name, val_types={f"list{i}": "i4" for i in range(num_lists)})


def plain(rows) -> list[list[object]]:
    """Rows as lists of numbers and lists."""
    names = rows.dtype.names
    return [[np.asarray(row[name]).tolist() for name in names] for row in rows]


@pytest.mark.filterwarnings("ignore:loadtxt")
@examples(100)
@given(st.data(), st.sampled_from(FORMS))
def test_every_form_is_read_as_plyfile_reads_it(tmp_path_factory, data: st.DataObject, form: dict) -> None:
    path = tmp_path_factory.mktemp("ply") / "a.ply"
    parts = [data.draw(elements("vertex")), data.draw(elements("face"))]
    PlyData(parts, comments=["a comment"], **form).write(str(path))
    found = read_elements(path.read_bytes())
    expected = PlyData.read(str(path))
    assert list(found) == ["vertex", "face"]
    for name, rows in found.items():
        assert rows.dtype.names == expected[name].data.dtype.names
        assert plain(rows) == plain(expected[name].data)


def test_line_ends_of_windows_and_numbers_of_every_spelling() -> None:
    lines = ["ply", "format ascii 1.0", "comment x", "obj_info y", "element vertex 2", "property float x", "end_header"]
    for end in ("\n", "\r\n", "\r"):
        data = end.join([*lines, "1.5e2", "nan", ""]).encode()
        np.testing.assert_array_equal(read_elements(data)["vertex"]["x"], np.array([150, np.nan], np.float32))


HEADER = "ply\nformat {form} 1.0\nelement vertex {count}\nproperty {what}\nend_header\n"


@pytest.mark.parametrize(
    ("text", "clause"),
    [
        ("plx\n", "does not begin with 'ply'"),
        ("ply\nelement vertex 1\nend_header\n", "no format"),
        ("ply\nformat ascii 2.0\nend_header\n", "its format is unknown"),
        ("ply\nformat\nend_header\n", "its format is unknown"),
        (HEADER.format(form="ascii", count=-1, what="float x"), "an element without a name or a number of rows"),
        (HEADER.format(form="ascii", count=1, what="half x"), "a property of an unknown type"),
        (HEADER.format(form="ascii", count=1, what="list float int x"), "a property of an unknown type"),
        (HEADER.format(form="ascii", count=1, what="float x\nproperty int x"), "two properties 'x'"),
        (HEADER.format(form="ascii", count=0, what="float x\nelement vertex 0"), "two elements 'vertex'"),
        (HEADER.format(form="ascii", count=1, what="float x\nnonsense"), "an unknown line 'nonsense'"),
        (HEADER.format(form="ascii", count=1, what="float x"), "'vertex' is cut"),
        (HEADER.format(form="ascii", count=1, what="float x") + "a\n", "does not fit its properties"),
        (HEADER.format(form="ascii", count=1, what="uchar x") + "300\n", "does not fit its properties"),
        (HEADER.format(form="ascii", count=1, what="list uchar int x") + "2 1\n", "a row that is too short"),
        (HEADER.format(form="ascii", count=1, what="list uchar int x") + "1 1 1\n", "a row that is too long"),
        (HEADER.format(form="ascii", count=1, what="float x") + "1\n2\n", "longer than its header says"),
        (HEADER.format(form="binary_little_endian", count=1, what="float x") + "12345", "longer than its header"),
        (HEADER.format(form="binary_little_endian", count=10**12, what="float x") + "1234", "'vertex' is cut"),
        (HEADER.format(form="binary_little_endian", count=10**12, what="list int int x") + "1234", "has 875770417 num"),
        ("ply\nformat binary_little_endian 1.0\nelement vertex 5\nend_header\n", "rows but no properties"),
    ],
)
def test_files_that_are_no_whole_ply_are_refused(text: str, clause: str) -> None:
    with pytest.raises(PlyError, match=clause):
        read_elements(text.encode())


@pytest.mark.parametrize("form", FORMS, ids=str)
def test_a_damaged_file_is_read_or_refused_and_takes_little_memory(tmp_path: Path, form: dict) -> None:
    rows = np.empty(40, [("x", "f4"), ("list", "O"), ("label", "u1")])
    for index in range(40):
        rows[index] = index, np.arange(index % 4, dtype=np.int32), index
    PlyData([PlyElement.describe(rows, "vertex")], **form).write(str(tmp_path / "a.ply"))
    whole, rng = (tmp_path / "a.ply").read_bytes(), random.Random(1)
    tracemalloc.start()
    try:
        for _ in range(300):
            data = rng.choice(MUTATIONS)(whole, rng)
            try:
                read_elements(data)
            except PlyError:
                continue
        assert tracemalloc.get_traced_memory()[1] < 20_000_000
    finally:
        tracemalloc.stop()
