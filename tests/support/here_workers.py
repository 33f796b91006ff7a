"""Workers of a run in tiles in the process of the test, which can change their functions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Self

import pytest

from octoreplay.study.tiles import run
from octoreplay.study.tiles.worker import Request, Setup


class HereWorkers:
    """Workers that answer in this process; ``requests`` are the names of their functions and subjects."""

    requests: list[tuple[str, str]]

    def __init__(self, setup: Setup, num_jobs: int) -> None:
        self._setup = setup

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        pass

    def answers(self, requests: Sequence[Request]) -> Iterator[Any]:
        """Yield the answers to requests in their order."""
        for request in requests:
            self.requests.append((request.function.__name__, request.name))
            yield request.function(self._setup, *request.arguments)


@pytest.fixture
def requests(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str]]:
    """Requests to workers in this process, which take the place of those on this machine."""
    monkeypatch.setattr(HereWorkers, "requests", [], raising=False)
    monkeypatch.setattr(run, "LocalWorkers", HereWorkers)
    return HereWorkers.requests
