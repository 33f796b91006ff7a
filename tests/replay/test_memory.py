"""The limit of a run's memory, and the forecast of its growth."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest

from octoreplay.config.team_file import load_team_file
from octoreplay.errors import MemoryLimitError
from octoreplay.replay import memory
from octoreplay.replay.memory import MemoryWatch, free_bytes, resident_bytes
from octoreplay.replay.run import replay_team
from octoreplay.result import open_result
from support.command_line import octoreplay
from support.fixture_paths import PAIR_TEAM

SECOND, GB = 10**9, 10**9
SETTINGS = {"resolution": 1.2, "duration": 3.0, "settle": 1}


def warnings_of(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, used: list[float], *, limit=None, total=100
) -> list[str]:
    """Warnings where a run uses some GB after each second and 10 GB are free at first."""
    watch = MemoryWatch(limit, None if total is None else total * SECOND)
    with caplog.at_level(logging.WARNING):
        for second, size in enumerate(used):
            monkeypatch.setattr(memory, "resident_bytes", lambda size=size: int(size * GB))
            monkeypatch.setattr(memory, "free_bytes", lambda size=size: int((10 - size) * GB))
            watch.check(second * SECOND)
    return [record.getMessage() for record in caplog.records]


def test_a_run_that_will_need_more_memory_than_there_is_says_so_once(monkeypatch, caplog) -> None:
    found = warnings_of(monkeypatch, caplog, [0.1 * second for second in range(60)], total=200)
    assert len(found) == 1
    # A quarter of the memory is used after 25 s; 7.5 GB are left.
    assert "grow by 100 MB per second of log time" in found[0]
    assert "all of 10 GB in 75 s of log time and 20 GB at the end of the logs" in found[0]


@pytest.mark.parametrize("used", [[0.05 * s for s in range(60)], [3.0] * 60, [9 - 0.1 * s for s in range(60)]])
def test_a_run_that_fits_says_nothing(monkeypatch, caplog, used: list[float]) -> None:
    assert warnings_of(monkeypatch, caplog, used) == []


def test_the_forecast_holds_for_the_limit_and_without_an_end(monkeypatch, caplog) -> None:
    found = warnings_of(monkeypatch, caplog, [1 + 0.01 * s for s in range(60)], limit=2 * GB, total=None)
    assert len(found) == 1
    assert "all of 2 GB" in found[0]


def test_a_run_above_its_limit_ends_with_a_sentence_and_can_be_resumed(tmp_path: Path) -> None:
    config = load_team_file(PAIR_TEAM).with_parameters(SETTINGS)
    replay_team(config, tmp_path / "whole.mcap")
    path = tmp_path / "out.mcap"
    with pytest.raises(MemoryLimitError, match=r"memory_limit: the run takes .* GB .* after the start") as raised:
        replay_team(config, path, memory_limit=1)
    assert "the finished part is in" in raised.value.__notes__[0]
    with open_result(tmp_path / "out.partial.mcap") as result:
        assert not result.is_complete
        assert len(result.metrics) == 1
    replay_team(config, path, resume=True)
    assert path.read_bytes() == (tmp_path / "whole.mcap").read_bytes()


def test_this_process_has_memory() -> None:
    assert 10**6 < resident_bytes() < 10**12
    free = free_bytes()
    assert free is None or 0 <= free < 10**15


@pytest.mark.parametrize("text", ["", "8", "0GB", "-1GB", "8 XB", "GB", "1e3GB", "nan GB", "9" * 400 + "GB"])
def test_other_sizes_are_refused(tmp_path: Path, text: str) -> None:
    done = octoreplay("run", PAIR_TEAM, "-o", tmp_path / "o.mcap", "--memory-limit", text)
    assert done.returncode == 2
    assert "is not a size such as 500MB or 8GB" in done.stderr
    assert list(tmp_path.iterdir()) == []
