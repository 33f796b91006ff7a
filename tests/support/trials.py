"""Random trials: a few with a fixed seed by default, many with the option `--campaign SECONDS`."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pytest


@dataclass
class Trials:
    """Random trials of one test.

    ``seconds`` is None by default, where the number of trials is fixed; else the time that the test may take.
    """

    name: str
    seed: int
    seconds: float | None

    def only_in_a_campaign(self, *, unless: bool = False) -> None:
        """Skip the test without the option ``--campaign``, for tests that take long."""
        if self.seconds is None and not unless:
            pytest.skip("only in a campaign")

    def rounds(self, few: int, most: int) -> Iterator[np.random.Generator]:
        """Yield one generator for each trial: ``few`` by default, up to ``most`` in a campaign; print their number."""
        end = None if self.seconds is None else time.monotonic() + self.seconds
        done = 0
        try:
            for trial in range(few if end is None else most):
                if end is not None and time.monotonic() > end:
                    break
                yield np.random.default_rng([self.seed, trial])
                done += 1
        finally:
            print(f"{self.name}: {done} trials of seed {self.seed} passed")
