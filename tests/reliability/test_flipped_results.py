"""One damaged byte anywhere in a result: the same answers, or an error that says 'damaged'."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from octoreplay.errors import OctoreplayError
from octoreplay.report.export import export_map
from octoreplay.result import open_result
from support.fixture_paths import FIXTURES
from support.trials import Trials

RESULT = FIXTURES / "result_3.mcap"
POINTS = np.array([[1.0, 2.0, 0.3], [4.0, -3.0, 0.9], [0.1, 0.1, 1.5], [500.0, 0.0, 0.0]])


def answers(path: Path, scratch: Path) -> list[Any]:
    """Everything that commands show of a result."""
    with open_result(path) as result:
        found: list[Any] = [result.robots, result.class_table, result.config, result.inputs, result.is_complete]
        for robot_id in (*result.robots, "central"):
            query = result.map(robot_id).query(POINTS)
            found += [query.log_odds.tobytes(), query.known.tobytes(), query.sizes.tobytes()]
        found += [result.evidence(robot_id).leaves().log_odds.tobytes() for robot_id in result.robots]
        found += [repr(result.metrics), repr(result.summary)]
        found += [sorted(maps) for maps in result.history()]
    export_map(path, scratch / "map.ply")
    return [*found, (scratch / "map.ply").read_bytes()]


@pytest.mark.parametrize("most", [0, 1 << 40], ids=["by parts", "as a whole"])
def test_every_flipped_byte_gives_the_same_answers_or_an_error(
    tmp_path: Path, trials: Trials, monkeypatch: pytest.MonkeyPatch, most: int
) -> None:
    """Large files are not read as a whole: their metadata and chunks have checksums of their own."""
    monkeypatch.setattr("octoreplay.io.results.checked_mcap.MAX_WHOLE", most)
    data = RESULT.read_bytes()
    (tmp_path / "result.mcap").write_bytes(data)
    expected = answers(tmp_path / "result.mcap", tmp_path)
    places = list(range(len(data)))
    for rng in trials.rounds(20, len(data)):
        # A campaign takes every byte once.
        place = places.pop() if trials.seconds is not None else int(rng.integers(len(data)))
        changed = bytearray(data)
        changed[place] ^= 1 << int(rng.integers(8))
        (tmp_path / "result.mcap").write_bytes(changed)
        found, refusal = None, ""
        try:
            found = answers(tmp_path / "result.mcap", tmp_path)
        except OctoreplayError as error:
            refusal = str(error)
        assert found == expected or "damaged" in refusal, f"byte {place}: {refusal}"
