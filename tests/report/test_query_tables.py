"""Tables of queries."""

from __future__ import annotations

import io

import numpy as np
import pytest

from octoreplay.report import tables
from octoreplay.report.query_tables import point_answers
from octoreplay.stored_map import PointQuery


@pytest.mark.parametrize(
    ("probabilities", "is_explained"),
    [((0.29, 0.28, 0.22, 0.21), True), ((0.6, 0.2, 0.1, 0.1), False), ((0.2, 0.5, 0.2, 0.1), False)],
)
def test_free_below_one_half_is_explained(probabilities: tuple[float, ...], *, is_explained: bool) -> None:
    row = np.array([probabilities])
    answer = PointQuery(
        known=np.array([True]),
        log_odds=np.log(row[:, 1:] / row[:, :1]),
        probabilities=row,
        labels=row.argmax(axis=1),
        sizes=np.array([0.1]),
    )
    text = io.StringIO()
    table = point_answers(("free", "ground", "tree", "rock"), [(0.0, 0.0, 0.0)], answer)
    tables.show(tables.terminal(file=text, width=100), table)
    assert ("free 29.00 %: no class" in text.getvalue()) == is_explained
