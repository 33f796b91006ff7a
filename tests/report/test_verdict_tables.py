"""Numbers in the tables of checks and comparisons."""

from __future__ import annotations

import io

import pytest

from octoreplay.evaluate.checks import CheckRow
from octoreplay.evaluate.comparison import MapDifference, ResultComparison
from octoreplay.report import tables, verdict_tables


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0, "0"), (1234567.0, "1,234,567"), (0.99899, "0.99899"), (float("nan"), "-"), (float("inf"), "inf"),
     (1.5e-7, "1.5e-07"), (1e20, "1e+20")],
)  # fmt: skip
def test_numbers_have_a_fixed_format(value: float, text: str) -> None:
    assert verdict_tables.six_digits(value) == text


def test_close_values_are_shown_with_enough_digits() -> None:
    row = CheckRow("min_agreement", 0.999, 0.9989999999, "alpha", None, None, passed=False)
    assert verdict_tables._values(row) == ("at least 0.999", "0.9989999999")


def test_a_comparison_of_large_maps_shows_all_digits_in_80_columns() -> None:
    one = MapDifference("husky_1", 5, 6, 119.0, 118.0, 204_867, 203_064, 1_204_038, 101_862, (), 8.90004, None, 109_707,
                        409_190, None, None)  # fmt: skip
    found = ResultComparison("a.mcap", "b.mcap", None, 0.0, False, (one,), (), (), True, True, True, ())
    text = io.StringIO()
    tables.show(tables.terminal(file=text, width=80), *verdict_tables.comparison(found))
    assert "…" not in text.getvalue()
    for count in ("119.0", "204,867", "101,862", "8.90004", "109,707", "409,190"):
        assert count in text.getvalue()
