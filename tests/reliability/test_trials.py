"""The trials themselves: equal seeds give equal trials, and their number follows the options."""

from __future__ import annotations

import pytest

from support.trials import Trials


def test_trials_of_one_seed_are_equal() -> None:
    first, second = ([random.random() for random in Trials("", 7, None).rounds(3, 9)] for _ in range(2))
    assert first == second
    assert len(set(first)) == 3


def test_a_campaign_makes_the_most_trials_within_its_time(capsys: pytest.CaptureFixture[str]) -> None:
    assert len(list(Trials("test", 1, 1e6).rounds(3, 9))) == 9
    assert "test: 9 trials of seed 1 passed" in capsys.readouterr().out


def test_a_campaign_ends_after_its_time() -> None:
    assert list(Trials("", 1, -1.0).rounds(3, 9)) == []
