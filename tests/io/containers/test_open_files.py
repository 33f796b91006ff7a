"""Limit of open files: raised where the system allows it, else refused in one sentence before the run."""

from __future__ import annotations

import resource
from pathlib import Path

import pytest

from octoreplay.errors import InputError
from octoreplay.io.containers import open_files
from octoreplay.io.containers.open_files import allow_open_files
from support.command_line import assert_fails
from support.fixture_paths import PAIR_TEAM


@pytest.fixture
def limits(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Soft and hard limit of a pretended system."""
    limits = [256, 1024]

    def set_limits(kind: int, pair: tuple[int, int]) -> None:
        if pair[0] > limits[1]:
            raise ValueError("not allowed to raise maximum limit")
        limits[:] = pair

    monkeypatch.setattr(open_files.resource, "getrlimit", lambda kind: tuple(limits))
    monkeypatch.setattr(open_files.resource, "setrlimit", set_limits)
    return limits


def test_the_limit_is_raised_only_where_it_is_needed(limits: list[int]) -> None:
    allow_open_files([Path("a.mcap")] * 52)
    assert limits == [256, 1024]
    allow_open_files([Path("a.mcap")] * 53)
    assert limits == [259, 1024]
    limits[0] = resource.RLIM_INFINITY
    allow_open_files([Path("a.mcap")] * 5000)
    assert limits == [resource.RLIM_INFINITY, 1024]


def test_files_of_a_folder_count(limits: list[int], tmp_path: Path) -> None:
    for index in range(60):
        (tmp_path / f"{index}.mcap").touch()
    allow_open_files([tmp_path])
    assert limits == [280, 1024]


def test_more_than_the_system_allows_is_refused_before_the_run(limits: list[int], tmp_path: Path) -> None:
    with pytest.raises(
        InputError, match=r"a.mcap and 1,099 more logs need 3,400 open files, but the system allows 256"
    ):
        allow_open_files([Path("a.mcap")] * 1100)
    limits[:] = [100, 100]
    assert_fails(1, r"raise the limit with 'ulimit -n 106'", "run", PAIR_TEAM, "-o", tmp_path / "out.mcap")
    assert not list(tmp_path.iterdir())
