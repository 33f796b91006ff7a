"""Comparisons over teams: means, paired differences, their tables in Markdown and LaTeX, and intervals."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.report.comparisons import (
    Comparison,
    Measure,
    by_team,
    latex,
    markdown,
    mean_over_teams,
    short,
    tables_of,
)
from octoreplay.report.intervals import MIN_TEAMS, Interval, interval

SCORE = Measure("score", "score", 2)
BYTES = Measure("bytes, kB", "bytes", None, 1e-3, is_ratio=True)
COMPARED = Comparison("runs", "rule", lambda row: str(row["rule"]), (SCORE, BYTES), "bayes", "graph")


def rows(scores: dict[str, list[float]], graph: str = "ring") -> list[dict]:
    """One run of 60 s for each rule and village; its bytes are 1000 times its score."""
    return [
        {"rule": rule, "graph": graph, "village": village, "score": score, "bytes": 1e3 * score, "log_seconds": 60.0}
        for rule, values in scores.items()
        for village, score in enumerate(values)
    ]


@given(st.lists(st.floats(-1e6, 1e6), min_size=MIN_TEAMS, max_size=12))
def test_an_interval_holds_the_mean_and_lies_within_the_values(values: list[float]) -> None:
    mean, low, high = interval(values)
    slack = 1e-9 * max(map(abs, values)) + 1e-300
    assert mean == pytest.approx(np.mean(values), rel=1e-9, abs=slack)
    assert min(values) - slack <= low <= high <= max(values) + slack


def test_tiny_differences_have_intervals_and_those_of_rounding_have_none() -> None:
    low, high = 0.0, 1e-200
    found = interval([low, low, low, low, high])
    assert low <= found.low < found.mean < found.high <= high
    # A power of two does not change the resamples.
    assert interval([0.1, 0.2, 0.3, 0.5, 0.9]) == tuple(v / 8 for v in interval([0.8, 1.6, 2.4, 4.0, 7.2]))
    mean, *ends = interval([1.0, 1.0, 1.0, 1.0, 1.0 + 4e-16])
    assert ends == [mean, mean]


def test_intervals_cover_the_true_mean_as_often_as_they_say() -> None:
    rng = np.random.default_rng(3)
    covered = [interval(rng.normal(1.0, 2.0, 20).tolist()) for _ in range(300)]
    share = np.mean([low <= 1.0 <= high for _, low, high in covered])
    # Bootstrap intervals of 20 values are a little too short.
    assert 0.88 < share < 0.98


def test_few_values_have_no_interval_and_missing_ones_are_left_out() -> None:
    assert math.isnan(interval([]).mean)
    few = interval([1.0, 2.0, math.nan])
    assert few.mean == 1.5
    assert math.isnan(few.low)
    assert not few.excludes(0.0)
    assert interval([0.3] * MIN_TEAMS) == Interval(0.3, 0.3, 0.3)


def test_differences_are_those_within_a_village() -> None:
    base = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    found = rows({"bayes": base, "flood": [value + 0.5 for value in base]})
    flood, bayes = (COMPARED.sections({"runs": found})["ring"][rule] for rule in ("flood", "bayes"))
    # The scores differ much between villages, the differences do not.
    assert COMPARED.change(SCORE, flood, bayes) == Interval(0.5, 0.5, 0.5)
    assert COMPARED.change(BYTES, flood, bayes).mean == pytest.approx(np.mean([(v + 0.5) / v for v in base]))
    # A village without a partner does not count.
    assert COMPARED.change(SCORE, flood, bayes[1:]) == Interval(0.5, 0.5, 0.5)


def test_runs_of_one_village_count_once() -> None:
    found = [*rows({"bayes": [1.0, 3.0]}), {**rows({"bayes": [2.0]})[0]}]
    assert by_team(found, "score") == {"0": 1.5, "1": 3.0}
    assert mean_over_teams(found, SCORE).mean == 2.25
    assert by_team([{"village": 0, "score": math.nan}, {"village": 1, "score": ""}, {"village": 2}], "score") == {}


def test_a_table_has_means_differences_intervals_and_stars() -> None:
    base = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    better = [value + change for value, change in zip(base, (0.5, 0.6, 0.4, 0.5, 0.7, 0.3), strict=True)]
    same = [value + change for value, change in zip(base, (0.5, -0.6, 0.4, -0.5, 0.2, 0.0), strict=True)]
    found = {"runs": rows({"bayes": base, "flood": better, "ratio": same})}
    (table,) = tables_of(COMPARED, found)
    assert table.title == "ring"
    assert table.headings == ("rule", "score", "- bayes", "bytes, kB", "/ bayes")
    assert table.lines[0] == ("bayes", "3.50", "", "3.5", "")
    assert table.lines[1][2].startswith("+0.50 [+0.4")
    assert table.lines[1][2].endswith("] \\*")
    assert table.lines[2][2].startswith("+0.00 [-0.")
    assert not table.lines[2][2].endswith("\\*")
    assert table.caption == (
        "18 runs of 60 s, 6 villages (seed 0 to 5). In brackets: 95% bootstrap intervals of differences and quotients"
        " within each village (10,000 resamples). \\*: the interval excludes equality."
    )
    text = markdown(table)
    lines = [line for line in text.splitlines() if line.startswith("|")]
    assert len({line.count("|") for line in lines}) == 1
    assert text.endswith(f"*{table.caption}*\n")


def test_sections_are_compared_by_themselves() -> None:
    found = {"runs": rows({"bayes": [1.0], "flood": [2.0]}) + rows({"bayes": [4.0], "flood": [3.0]}, "line")}
    ring, line = tables_of(COMPARED, found)
    assert (ring.title, line.title) == ("ring", "line")
    named = tables_of(dataclasses.replace(COMPARED, title="six robots"), found)
    assert [table.title for table in named] == ["six robots, ring", "six robots, line"]
    assert [ring.lines[1][2], line.lines[1][2]] == ["+1.00", "-1.00"]


def test_without_a_baseline_a_table_has_intervals_of_means() -> None:
    alone = dataclasses.replace(COMPARED, baseline=None, section=None)
    (table,) = tables_of(alone, {"runs": rows({"flood": [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]})})
    assert table.headings == ("rule", "score", "bytes, kB")
    assert table.lines[0][1].startswith("3.50 [2.")
    assert "intervals of means" in table.caption


def test_the_caption_has_the_noun_of_what_is_paired() -> None:
    base = [1.0, 2.0, 3.0, 4.0, 5.0]
    teams = dataclasses.replace(COMPARED, unit="team")
    (table,) = tables_of(teams, {"runs": rows({"bayes": base, "flood": base})})
    assert table.caption.startswith("10 runs of 60 s, 5 teams (seed 0 to 4). ")
    assert "within each team (" in table.caption
    (alone,) = tables_of(teams, {"runs": rows({"bayes": base[:1]})})
    assert alone.caption == "1 runs of 60 s, 1 team (seed 0)."


def test_a_missing_number_is_a_dash() -> None:
    found = rows({"bayes": [1.0, 2.0], "local": [math.nan, math.nan]})
    (table,) = tables_of(COMPARED, {"runs": found})
    assert table.lines[1] == ("local", "-", "-", "-", "-")


def test_latex_escapes_what_it_treats_in_a_special_way() -> None:
    found = {"runs": rows({"bayes": [1.0] * 6, "a_b & 5 %, γ": [2.0] * 6})}
    (table,) = tables_of(dataclasses.replace(COMPARED, section=None), found)
    text = latex(table)
    assert r"a\_b \& 5 \%, $\gamma$ & 2.00 & +1.00 [+1.00, +1.00] $^*$ &" in text
    body = text.partition(r"\midrule")[2].partition(r"\bottomrule")[0].strip().splitlines()
    assert all(line.endswith(r"\\") for line in body)
    assert {line.replace(r"\&", "").count("&") for line in body} == {4}
    for begin, end in itertools.pairwise([r"\begin{table}", r"\begin{tabular}", r"\end{tabular}", r"\end{table}"]):
        assert text.index(begin) < text.index(end)


@pytest.mark.parametrize(
    ("value", "text"), [(math.nan, "-"), (0.0, "0"), (1234.5, "1,234"), (0.12345, "0.123"), (2e6, "2.0e+06"), (3, "3")]
)
def test_numbers_have_three_digits(value: float, text: str) -> None:
    assert short(value) == text
