"""Numbers in the tables of checks."""

from __future__ import annotations

import pytest

from octoreplay.evaluate.checks import CheckRow
from octoreplay.report import verdict_tables


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
