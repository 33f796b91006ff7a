"""Check of what a command leaves after an interrupt or a fault: the old output, a complete new one, or a partial."""

from __future__ import annotations

from pathlib import Path

from octoreplay.errors import InputError
from octoreplay.result import open_result
from support.fixture_paths import PAIR_TEAM
from support.forked import Done

QUICK_RUN = ("run", PAIR_TEAM, "--resolution", "0.6", "--settle", "1", "--duration", "2", "--force", "-o", "x.mcap")
"""Arguments of a run of a quarter of a second."""


def content(folder: Path) -> dict[str, bytes]:
    """Return the bytes of all files below a folder, by relative path, without locks."""
    files = (path for path in folder.rglob("*") if path.is_file() and not path.name.endswith(".lock"))
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def one_sentence(done: Done) -> None:
    """Check that an error is one sentence without a traceback."""
    notes = ("warning: ", "IoU, coverage and calibration need ")
    lines = [line for line in done.err.splitlines() if line and not line.startswith(notes)]
    assert "Traceback" not in done.err, done.err
    assert "defect of octoreplay" not in done.err, done.err
    assert len(lines) == (0 if done.code in (0, 3) else 1), (done.code, done.err)


def check_partial(path: Path, whole: Path) -> None:
    """Check that an unfinished result can be opened and holds the first ticks of the whole result."""
    with open_result(path) as found, open_result(whole) as expected:
        assert found.metrics
        assert [repr(tick) for tick in found.metrics] == [repr(t) for t in expected.metrics[: len(found.metrics)]]
        try:
            found.map(found.robots[0]).leaves()
        except InputError as error:
            assert "no map" in str(error)  # noqa: PT017 - the error is one of several outcomes
