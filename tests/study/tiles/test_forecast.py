"""Forecast of memory, and the tiles that it chooses."""

from __future__ import annotations

import dataclasses
import tempfile
from pathlib import Path

import numpy as np
import pytest

from octoreplay.config.team_file import load_team_file
from octoreplay.errors import ConfigError, MemoryLimitError
from octoreplay.evaluate.comparison import compare_results
from octoreplay.io.robots.discover import resolve
from octoreplay.io.robots.sensor_logs import SensorCounts
from octoreplay.mapping.octree import keys_to_codes
from octoreplay.records import FrameCounts
from octoreplay.replay.run import replay_team
from octoreplay.result import open_result
from octoreplay.study.tiles import forecast, run
from octoreplay.study.tiles.scans import SAMPLE, ScanIndex
from support.fixture_paths import TRIO_TEAM
from support.long_suite import long

EMPTY = np.zeros(0, np.int64)


def scans_of(keys, num_axes=2):
    """Index of a robot that touches the bricks with these keys of their lowest cells."""
    codes = np.unique(keys_to_codes(np.array(keys, np.int64)) >> 6)
    blocks = np.zeros((0, num_axes), np.int64)
    counts = SensorCounts((FrameCounts(),), FrameCounts())
    return ScanIndex(64, EMPTY, EMPTY, np.zeros((0, 4, 4)), EMPTY, blocks, np.zeros((0, 3), np.int64), codes, counts)


@pytest.fixture(scope="module")
def config():
    return resolve(load_team_file(TRIO_TEAM))


def test_the_estimate_is_the_number_of_bricks_where_all_are_seen_often() -> None:
    codes = np.repeat(np.arange(1000), 3)
    assert forecast._estimated(codes) == 1000 * SAMPLE


@pytest.mark.parametrize("seed", range(5))
def test_bricks_that_no_sampled_scan_sees_are_estimated(seed) -> None:
    # 20 scans see each of 5000 bricks with a chance of 0.1.
    seen = np.random.default_rng(seed).random((20, 5000)) < 0.1
    codes = np.concatenate([np.flatnonzero(scan) for scan in seen])
    assert np.unique(codes).size < 4500
    assert forecast._estimated(codes) == pytest.approx(5000 * SAMPLE, rel=0.05)


def test_the_memory_of_the_largest_tile_counts(config) -> None:
    one = scans_of([[4 * n, 0, 0] for n in range(10)] + [[400, 0, 0]])
    other = scans_of([[4 * n, 4, 0] for n in range(6)] + [[0, 0, 0]])
    # Tile 0 has 10 and 7 bricks, 16 different ones.
    expected = forecast.MARGIN * forecast.Bricks(17 * SAMPLE, 16 * SAMPLE).memory(config)
    assert forecast.tile_memory(config, [one, other], 64) == round(expected)


def test_cubes_divide_the_heights(config) -> None:
    keys = [[0, 0, 4 * n] for n in range(64)]
    columns, cubes = (forecast.tile_memory(config, [scans_of(keys, n)], 64) for n in (2, 3))
    assert columns > cubes
    assert cubes == round(forecast.MARGIN * forecast.Bricks(16 * SAMPLE, 16 * SAMPLE).memory(config))


def test_the_largest_tiles_that_fit_are_chosen(config) -> None:
    scans = [scans_of([[4 * x, 4 * y, 0] for x in range(128) for y in range(128)])]
    sizes = {cells: forecast.tile_memory(config, scans, cells) for cells in (64, 128, 256, 512)}
    assert sorted(sizes.values()) == list(sizes.values())
    assert forecast.chosen_cells(config, scans, 1e12) == 512
    assert forecast.chosen_cells(config, scans, sizes[512] - 1) == 256
    assert forecast.chosen_cells(config, scans, sizes[64]) == 64
    with pytest.raises(ConfigError, match=r"^memory_limit: a tile of 19\.2 m, the smallest one, takes about 0\.3"):
        forecast.chosen_cells(config, scans, sizes[64] - 1)


def test_rules_that_exchange_nothing_take_less(config) -> None:
    local = dataclasses.replace(config, consensus=dataclasses.replace(config.consensus, rule="local"))
    bricks = forecast.Bricks(1e6, 1e6)
    assert bricks.memory(local) < bricks.memory(config)


def test_a_sample_of_the_scans_gives_about_the_memory_of_all(config) -> None:
    replay_bricks = forecast.whole_memory(config) - forecast.Bricks(0, 0).memory(config)
    exact = _exact_bricks(config).memory(config) - forecast.Bricks(0, 0).memory(config)
    assert replay_bricks == pytest.approx(exact, rel=0.3)


def _exact_bricks(config):
    """Bricks of the fixture's maps, from a run."""
    with tempfile.TemporaryDirectory() as folder:
        replay_team(config, Path(folder) / "o.mcap")
        with open_result(Path(folder) / "o.mcap") as result:
            evidence = [result.evidence(name).octree.codes for name in result.robots]
    return forecast.Bricks(sum(map(len, evidence)), len(np.unique(np.concatenate(evidence))))


def test_small_limits_leave_no_room_for_tiles(config) -> None:
    assert not forecast.takes_tiles(config, 400_000_000)
    assert not forecast.takes_tiles(config, 10**12)


@long
def test_tiles_that_take_more_than_forecast_become_smaller(tmp_path: Path, monkeypatch) -> None:
    config, tried = load_team_file(TRIO_TEAM), []
    replay_logs = run._replay_logs

    def replay(tiles, *arguments):
        tried.append(tiles[0].num_cells)
        stages = replay_logs(tiles, *arguments)
        if len(tried) == 1:
            raise MemoryLimitError("tile_0_0: takes more")
        return stages

    monkeypatch.setattr(run, "_replay_logs", replay)
    # Smaller tiles of a small map take less where the forecast is that of their bricks alone.
    monkeypatch.setattr(run, "_RETRY_SHARE", 0.99)
    for module in (run, forecast):
        monkeypatch.setattr(module, "BLOCK_CELLS", 32)
    monkeypatch.setattr(forecast, "PROCESS_BYTES", 0)
    monkeypatch.setattr(forecast, "ROBOT_BYTES", 0)
    run.replay_tiles(config, tmp_path / "tiled.mcap", memory_limit=10**12)
    assert len(tried) == 2
    assert tried[1] < tried[0]
    replay_team(config, tmp_path / "whole.mcap")
    assert compare_results(tmp_path / "whole.mcap", tmp_path / "tiled.mcap").is_same


@long
def test_a_tile_above_the_limit_of_its_process_ends_the_run(tmp_path: Path) -> None:
    with pytest.raises(MemoryLimitError, match=r"^tile_.*: takes .* GB, more than .* smaller --tiles"):
        run.replay_tiles(load_team_file(TRIO_TEAM), tmp_path / "tiled.mcap", 40.0, memory_limit=300_000_000)
    run.replay_tiles(load_team_file(TRIO_TEAM), tmp_path / "tiled.mcap", 40.0, resume=True)
    assert (tmp_path / "tiled.mcap").exists()
