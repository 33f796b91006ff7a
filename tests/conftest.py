"""Results of the committed teams, made by one worker and read by all, and switches for the code under test."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import settings

from support import long_suite
from support.fixture_paths import PAIR_TEAM, TRIO_TEAM

IS_COMPILED = os.environ.get("NUMBA_DISABLE_JIT") != "1"

if not IS_COMPILED:
    from support import plain_intrinsics

    plain_intrinsics.install()

# Random tests try the same examples in every run. `--hypothesis-profile explore` tries new ones.
settings.register_profile("fixed", derandomize=True, deadline=None)
settings.register_profile("explore", deadline=None)
settings.load_profile("fixed")

SharedFile = Callable[[str, Callable[[Path], object]], Path]


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--campaign", type=float, metavar="SECONDS", help="time of each test of tests/reliability")
    parser.addoption("--seed", type=int, help="seed of tests/reliability; default: fixed, with --campaign a new one")


def pytest_configure(config: pytest.Config) -> None:
    from octoreplay.replay.exchange.packet_codec import PacketCodec

    long_suite.is_long_suite = config.getoption("markexpr") == "long"
    # Receivers decode every packet in the default suite, so that an error in the encoder changes a run. In the long
    # suite they share the sender's maps, as they do by default.
    PacketCodec.always_decodes = not long_suite.is_long_suite
    if not IS_COMPILED:
        # Kernels let integers overflow and divide by 0, of which numpy warns in Python.
        config.addinivalue_line("filterwarnings", "ignore::RuntimeWarning")


def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile the kernels once, before the workers start: each of them would compile its own."""
    if IS_COMPILED and session.config.getoption("numprocesses", None):
        from octoreplay.mapping.warm_up import compile_if_needed

        compile_if_needed()


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Select the random tests in both suites: with few examples in the default one, with all in the long one."""
    for item in items:
        if long_suite.is_long_suite and item.get_closest_marker("examples"):
            item.add_marker(long_suite.long)


@pytest.fixture(scope="session")
def shared_file(tmp_path_factory: pytest.TempPathFactory) -> SharedFile:
    """Function that returns the path of a file or folder, made by ``make(path)`` in the worker that asks first."""
    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent
    folder = folder / "shared"
    folder.mkdir(exist_ok=True)

    def shared(name: str, make: Callable[[Path], object]) -> Path:
        path = folder / name
        with (folder / f"{name}.lock").open("a") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            # The lock file stays empty where ``make`` fails.
            if not os.fstat(lock.fileno()).st_size:
                make(path)
                lock.write("made")
        return path

    return shared


@pytest.fixture(scope="session")
def pair_result(shared_file: SharedFile) -> Path:
    """Result of the team of two robots, with a stored map every second."""
    return shared_file("pair.mcap", lambda path: _replay(PAIR_TEAM, path, state_every=1.0, view_every=2.0))


@pytest.fixture(scope="session")
def trio_result(shared_file: SharedFile) -> Path:
    """Result of the team of three robots by rule bayes, with a stored map every second."""
    return shared_file("trio.mcap", lambda path: _replay(TRIO_TEAM, path, rule="bayes", state_every=1.0))


def _replay(team: Path, path: Path, **parameters: object) -> None:
    """Replay a committed team into ``path``."""
    # Imported at first use: most files of tests need no replay.
    from octoreplay.config.team_file import load_team_file
    from octoreplay.io.robots.discover import resolve
    from octoreplay.replay.run import replay_team

    replay_team(resolve(load_team_file(team).with_parameters(parameters)), path)
