"""Results of earlier formats give the same as that of the present one (tests/fixtures/make_results.py)."""

from __future__ import annotations

import numpy as np
import pytest

from octoreplay.io.results.result_metadata import FORMAT_VERSION, READABLE_VERSIONS
from octoreplay.result import Result, open_result
from support.fixture_paths import FIXTURES


def answers(result: Result) -> list[object]:
    """Everything that does not name the version or the logs."""
    found: list[object] = [result.robots, result.class_table, repr(result.metrics), repr(result.summary)]
    found += [result.config.map, result.config.consensus, result.config.network, list(result.inputs.values())]
    for robot_id in (*result.robots, "central"):
        leaves = result.map(robot_id).leaves()
        found += [result.stored_ticks(robot_id), leaves.log_odds.tobytes(), leaves.centers.tobytes()]
    query = result.evidence(result.robots[0]).query(np.array([[1.0, 2.0, 0.3], [4.0, -3.0, 0.9]]))
    return [*found, query.log_odds.tobytes(), query.known.tolist()]


def test_every_readable_format_has_a_stored_result() -> None:
    assert {path.stem.removeprefix("result_") for path in FIXTURES.glob("result_*.mcap")} == set(READABLE_VERSIONS)


@pytest.mark.parametrize("version", [version for version in READABLE_VERSIONS if version != FORMAT_VERSION])
def test_results_of_earlier_formats_are_read(version: str) -> None:
    paths = [FIXTURES / f"result_{name}.mcap" for name in (version, FORMAT_VERSION)]
    with open_result(paths[0]) as old, open_result(paths[1]) as present:
        assert answers(old) == answers(present)
        # Their logs are the committed ones.
        assert [robot.logs for robot in old.config.robots] == [robot.logs for robot in present.config.robots]
        assert old._reader.changed_inputs() == present._reader.changed_inputs() == []
