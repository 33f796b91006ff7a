from __future__ import annotations

import re
from decimal import Decimal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.errors import InputError
from octoreplay.io.text_tables import floats, rows, seconds_to_ns


def test_rows_have_their_line_and_no_comments(tmp_path):
    path = tmp_path / "a.txt"
    path.write_bytes(b"# head\n1 2,3\r\n\n  \n4,5 ,6 # why\n#7\n8")
    assert list(rows(path)) == [
        (f"{path} line 2", ["1", "2", "3"]), (f"{path} line 5", ["4", "5", "6"]), (f"{path} line 7", ["8"]),
    ]  # fmt: skip


def test_files_that_are_not_text(tmp_path):
    path = tmp_path / "a.txt"
    with pytest.raises(InputError, match=f"^{re.escape(str(path))}: cannot be read: "):
        list(rows(path))
    path.write_bytes(b"\xff\xfe\0")
    with pytest.raises(InputError, match=f"^{re.escape(str(path))}: is not a text file"):
        list(rows(path))
    with pytest.raises(InputError, match="cannot be read"):
        list(rows(tmp_path))


@given(st.integers(0, 1 << 61))
def test_seconds_are_exact_to_the_nanosecond(stamp_ns):
    assert seconds_to_ns("here", f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09}") == stamp_ns
    assert seconds_to_ns("here", f"{Decimal(stamp_ns) / 10**9:e}") == stamp_ns


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("1700000000.123456789", 1_700_000_000_123_456_789), ("1.5e-9", 2), ("-0.25", -250_000_000),
        ("7", 7_000_000_000), ("1.0000000004", 1_000_000_000), ("1e-999999", 0),
    ],
)  # fmt: skip
def test_seconds_in_any_form(text, expected):
    assert seconds_to_ns("here", text) == expected


@pytest.mark.parametrize(
    "text", ["", "x", "nan", "-inf", "1e99", "1e999999", "1e99999999", "9" * 5000, "4294967296", "0x10", "sNaN"]
)
def test_invalid_times_are_refused_with_their_line(text):
    with pytest.raises(InputError, match=r"^a\.txt, line 3: '.*' is not a time in seconds$"):
        seconds_to_ns("a.txt, line 3", text)


def test_floats():
    numbers = floats("here", ["1", "-2.5e3", ".5", "nan", "-inf"])
    np.testing.assert_array_equal(numbers, [1.0, -2500.0, 0.5, np.nan, -np.inf])
    for bad in ("x", "", "1,5"):
        with pytest.raises(InputError, match=r"^a\.txt line 3: expects numbers, got '1 .*'$"):
            floats("a.txt line 3", ["1", bad])
