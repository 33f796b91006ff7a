"""Runs that are interrupted after a tick and continued."""

from __future__ import annotations

from pathlib import Path

import pytest

from octoreplay.config.run import RunConfig
from octoreplay.replay.run import replay_team
from octoreplay.run_metrics import RunSummary


def interrupted_after(tick: int, config: RunConfig, output: Path, **options: bool | float) -> None:
    """Interrupt a run after a tick."""

    def progress(now):
        if now.tick == tick:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        replay_team(config, output, progress=progress, **options)


def resumed(config: RunConfig, output: Path, *ticks: int) -> RunSummary:
    """Interrupt a run after some ticks, each time continue it, and let it end."""
    for tick in ticks:
        interrupted_after(tick, config, output, resume=tick != ticks[0])
    return replay_team(config, output, resume=True)
