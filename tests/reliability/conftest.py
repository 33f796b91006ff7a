"""The random trials of each test, and the server of forked command lines."""

from __future__ import annotations

import secrets
from collections.abc import Iterator
from pathlib import Path

import pytest

from support.forked import ForkServer
from support.outcomes import QUICK_RUN
from support.trials import Trials


@pytest.fixture
def trials(request: pytest.FixtureRequest) -> Trials:
    """Trials of this test; a failure is repeated with the seed that the test prints."""
    seconds = request.config.getoption("--campaign")
    seed = request.config.getoption("--seed")
    if seed is None:
        seed = 0 if seconds is None else secrets.randbits(31)
    return Trials(request.node.name, seed, seconds)


@pytest.fixture(scope="session")
def server(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[ForkServer]:
    """Server of command lines that start quickly."""
    is_campaign = request.config.getoption("--campaign") is not None
    with ForkServer(tmp_path_factory.mktemp("server"), with_readers=is_campaign) as server:
        yield server


@pytest.fixture(scope="session")
def results(server: ForkServer, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the result r.mcap of ``QUICK_RUN``, and r.partial.mcap, the same without its end."""
    folder = tmp_path_factory.mktemp("results")
    done = server.run(*QUICK_RUN, folder=folder)
    assert done.code == 0, done.err
    (folder / "x.mcap").rename(folder / "r.mcap")
    data = (folder / "r.mcap").read_bytes()
    (folder / "r.partial.mcap").write_bytes(data[: data.rindex(b"summary") - 20])
    return folder
