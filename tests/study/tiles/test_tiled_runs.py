"""Runs in tiles give the result of whole runs."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import pytest
from mcap.reader import make_reader

from octoreplay.config.team_file import load_team_file
from octoreplay.io.results.result_reader import ResultReader
from octoreplay.io.results.topics import CONTRADICTION_TOPIC, METRICS_TOPIC
from octoreplay.replay.run import replay_team
from octoreplay.run_metrics import TickMetrics
from octoreplay.study.tiles.run import replay_tiles
from support.fixture_paths import TRIO_TEAM
from support.long_suite import long

EDGE = 9.6
"""Least edge of tiles of the fixture, 32 cells [m]."""
OF_TILES = {"packet_bytes", "sent_bytes", "delivered_bytes", "memory_bytes", "unpruned_compressed_bytes",
            "bytes_per_second"}  # fmt: skip
"""Numbers that are sums over tiles, not those of the whole map."""
OF_PACKETS = {"num_sent", "num_delivered", "num_late", "num_stale"}
"""Numbers of the packets of rules 'flood' and 'latest', which send a tile's evidence only where that changed."""
FORWARDS_EVIDENCE = ("flood", "latest")
CONFIGURATIONS = {
    "defaults": {},
    "gradient": {"rule": "gradient", "packets": "full"},
    "natural, line": {"rule": "natural", "topology": "line"},
    "bayes, loss, late": {"rule": "bayes", "loss": 0.3, "latency": 0.7, "jitter": 0.3},
    "acknowledged, damaged": {"rule": "gradient", "loss": 0.2, "corruption": 0.2, "acknowledge": True},
    "ratio, loss": {"rule": "ratio", "loss": 0.2, "packets": "full"},
    "flood": {"rule": "flood", "latency": 0.7},
    "merge": {"rule": "merge"},
    "weighted, loss, late": {"rule": "weighted", "loss": 0.3, "latency": 0.7, "jitter": 0.3},
    "latest, range": {"rule": "latest", "latency": 0.7, "topology": "range", "radio_range": 4.0},
    "on arrival": {"mode": "on-arrival", "latency": 1.5, "jitter": 0.5},
    "int8": {"content": "int8"},
    "time average": {"rule": "gradient", "evidence": "time-average"},
    "cell average": {"rule": "natural", "evidence": "cell-average"},
    "plain floats": {"flow_bits": 0, "quantum": 0.0},
    "plain floats, loss": {"flow_bits": 0, "quantum": 0.0, "loss": 0.3},
    "random graph, other programs": {
        "topology": "random",
        "evidence_every": 1.0,
        "grid_every": 1.0,
        "markers_every": 2.0,
        "octomap_every": 2.0,
    },
    "range": {"topology": "range", "radio_range": 4.0, "range_hysteresis": 1.0},
    "broadcast": {"cast": "broadcast"},
    "no settling": {"settle": 0},
    "bounds": {"bounds": (-3.0, -4.0, 0.0, 9.0, 3.0, 2.0)},
}
IN_DEFAULT_SUITE = ("defaults",)


def team(**parameters):
    return load_team_file(TRIO_TEAM).with_parameters({"state_every": 1.0, "view_every": 3.0, **parameters})


def check_metrics(whole: TickMetrics, tiled: TickMetrics, ignored: set[str]) -> None:
    """Compare the metrics of a tick."""
    check_equal(plain(whole), plain(tiled), ignored, f"tick {whole.tick}")


def plain(metrics: TickMetrics) -> dict:
    values = dataclasses.asdict(metrics)
    return {**values, "robots": [dict(r) for r in values["robots"]], "links": [dict(x) for x in values["links"]]}


def check_equal(whole, tiled, ignored, name: str) -> None:
    """Compare values: integers and texts exactly, real numbers to 1e-12, and those ``ignored`` not at all."""
    if isinstance(whole, dict):
        assert whole.keys() == tiled.keys()
        for key in whole.keys() - ignored:
            check_equal(whole[key], tiled[key], ignored, f"{name}, {key}")
    elif isinstance(whole, list | tuple):
        assert len(whole) == len(tiled), name
        for n, (one, other) in enumerate(zip(whole, tiled, strict=True)):
            check_equal(one, other, ignored, f"{name}[{n}]")
    elif isinstance(whole, float) and not math.isnan(whole):
        assert tiled == pytest.approx(whole, rel=1e-12, abs=1e-300), name
    else:
        assert tiled == whole or (whole != whole and tiled != tiled), name


def messages_of(path: Path) -> dict[str, list[tuple[int, bytes]]]:
    """Messages of each topic of a result but the metrics: maps, evidence, views, poses, graph."""
    found: dict[str, list[tuple[int, bytes]]] = {}
    with path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages(log_time_order=False):
            if channel.topic not in (METRICS_TOPIC, CONTRADICTION_TOPIC):
                found.setdefault(channel.topic, []).append((message.log_time, message.data))
    return found


@pytest.mark.parametrize(
    "parameters",
    [pytest.param(values, id=name, marks=() if name in IN_DEFAULT_SUITE else long)
     for name, values in CONFIGURATIONS.items()],
)  # fmt: skip
@pytest.mark.parametrize("cut_heights", [False, pytest.param(True, marks=long)])
def test_tiles_give_the_result_of_the_whole_run(tmp_path: Path, parameters, cut_heights) -> None:
    config = team(**parameters)
    whole = replay_team(config, tmp_path / "whole.mcap")
    tiled = replay_tiles(config, tmp_path / "tiled.mcap", EDGE, cut_heights=cut_heights)
    assert sorted(path.name for path in tmp_path.iterdir() if not path.name.startswith(".")) == [
        "tiled.mcap", "whole.mcap"
    ]  # fmt: skip
    with ResultReader(tmp_path / "whole.mcap") as one, ResultReader(tmp_path / "tiled.mcap") as other:
        metrics = one.metrics()
        assert len(metrics) == len(other.metrics())
        for before, now in zip(metrics, other.metrics(), strict=True):
            check_metrics(before, now, OF_TILES | (OF_PACKETS if config.consensus.rule in FORWARDS_EVIDENCE else set()))
        assert one.topics == other.topics
    assert messages_of(tmp_path / "whole.mcap") == messages_of(tmp_path / "tiled.mcap")
    assert (tiled.stop_reason, tiled.num_settling_ticks) == (whole.stop_reason, whole.num_settling_ticks)
    assert (tiled.frame_counts, tiled.warnings) == (whole.frame_counts, whole.warnings)
