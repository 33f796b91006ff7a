"""Runs that continue after a check point end with the bytes of an undisturbed run."""

from __future__ import annotations

import dataclasses
import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest
import zstandard
from isal import isal_zlib

from octoreplay.config.team_file import load_team_file
from octoreplay.errors import ConfigError, InputError
from octoreplay.io.output_file import OutputFile
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.mapping.snapshot import Snapshot
from octoreplay.replay import checkpoint
from octoreplay.replay.checkpoint import checkpoint_path
from octoreplay.replay.run import replay_team
from support.fixture_paths import TRIO, TRIO_TEAM
from support.interrupted import interrupted_after, resumed
from support.long_suite import long, one_in

CONFIGURATIONS = {
    "defaults": {},
    "gradient": {"rule": "gradient", "packets": "full"},
    "natural, line": {"rule": "natural", "topology": "line"},
    "ratio, loss": {"rule": "ratio", "loss": 0.2, "packets": "full"},
    "flood, late": {"rule": "flood", "loss": 0.2, "latency": 0.7, "grid_every": 1.0, "octomap_every": 2.0},
    "merge": {"rule": "merge"},
    "weighted, loss": {"rule": "weighted", "loss": 0.2},
    "latest, late": {"rule": "latest", "loss": 0.2, "latency": 0.7},
    "on arrival, late": {"mode": "on-arrival", "latency": 1.5, "jitter": 0.5},
    "rate": {"rate": 20_000.0, "queue": "newest"},
    "budget": {"budget": 20_000},
    "int8, decoded, damaged": {"content": "int8", "decode_packets": True, "corruption": 0.2},
    "time average": {"rule": "gradient", "evidence": "time-average"},
    "cell average": {"rule": "natural", "evidence": "cell-average"},
    "plain floats": {"flow_bits": 0, "quantum": 0.0},
    "random graph, packets": {"topology": "random", "keep_packets": True},
    "no settling": {"settle": 0},
}
IN_DEFAULT_SUITE = ("defaults",)


def team(**parameters):
    return load_team_file(TRIO_TEAM).with_parameters({"state_every": 1.0, **parameters})


@pytest.mark.parametrize(
    "parameters",
    [
        pytest.param(parameters, id=name, marks=() if name in IN_DEFAULT_SUITE else long)
        for name, parameters in CONFIGURATIONS.items()
    ],
)
def test_a_resumed_run_ends_with_the_same_bytes(tmp_path: Path, parameters) -> None:
    config = team(**parameters)
    summary = replay_team(config, tmp_path / "whole.mcap")
    last = summary.num_ticks - 1
    ticks = sorted({0, last // 3, last // 3 + 1, last - 1})
    again = resumed(config, tmp_path / "resumed.mcap", *ticks)
    assert (tmp_path / "resumed.mcap").read_bytes() == (tmp_path / "whole.mcap").read_bytes()
    assert dataclasses.replace(again, wall_seconds=0.0) == dataclasses.replace(summary, wall_seconds=0.0)
    assert sorted(path.name for path in tmp_path.glob("resumed*")) == ["resumed.mcap"]


def test_resuming_says_where_it_continues(tmp_path: Path, caplog) -> None:
    caplog.set_level("INFO", "octoreplay")
    interrupted_after(2, team(), tmp_path / "out.mcap")
    interrupted_after(4, team(), tmp_path / "out.mcap", resume=True)
    assert f"{tmp_path / 'out.mcap'}: continues after tick 2, 2.0 s of log time" in caplog.text


@long
def test_without_a_check_point_a_run_starts_from_the_beginning(tmp_path: Path, caplog) -> None:
    caplog.set_level("INFO", "octoreplay")
    output = tmp_path / "out.mcap"
    interrupted_after(2, team(), output, checkpoint_every=0.0)
    assert not checkpoint_path(output).exists()
    replay_team(team(), output, resume=True)
    assert f"{output}: nothing to resume; starts from the beginning" in caplog.text


# --- refusals ---------------------------------------------------------------------------------------------------------


def test_other_settings_are_refused_and_nothing_is_lost(tmp_path: Path) -> None:
    output = tmp_path / "out.mcap"
    interrupted_after(2, team(), output)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(
        ConfigError, match=r"'gamma: 0.3' was 'gamma: .*'; use the same settings, or run with --restart"
    ):
        replay_team(team(gamma=0.3), output, resume=True)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_other_inputs_are_refused(tmp_path: Path) -> None:
    shutil.copytree(TRIO, tmp_path / "trio")
    config, output = load_team_file(tmp_path / "trio" / "team.yaml"), tmp_path / "out.mcap"
    interrupted_after(2, config, output)
    log = tmp_path / "trio" / "husky_2.mcap"
    log.write_bytes(log.read_bytes() + b"\0")
    with pytest.raises(ConfigError, match=r"the log '.*husky_2.mcap' is not as it was"):
        replay_team(config, output, resume=True)


def test_other_versions_are_refused(tmp_path: Path, monkeypatch) -> None:
    output = tmp_path / "out.mcap"
    interrupted_after(2, team(), output)
    monkeypatch.setattr(checkpoint, "__version__", "99")
    with pytest.raises(ConfigError, match="other versions of octoreplay, Python or NumPy"):
        replay_team(team(), output, resume=True)


@pytest.mark.parametrize(
    "damage", one_in(3, [lambda data: data[:-40], lambda data: data[:50] + b"\1" + data[51:], lambda _: b""])
)
def test_damaged_check_points_are_refused(tmp_path: Path, damage) -> None:
    output = tmp_path / "out.mcap"
    interrupted_after(2, team(), output)
    path = checkpoint_path(output)
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(InputError, match=r"out.checkpoint: damaged, or no check point; run with --restart"):
        replay_team(team(), output, resume=True)


@long
def test_a_damaged_partial_result_is_refused(tmp_path: Path) -> None:
    output = tmp_path / "out.mcap"
    interrupted_after(5, team(view_every=0.5, state_every=0.5, resolution=0.1), output)
    partial = tmp_path / "out.partial.mcap"
    data = bytearray(partial.read_bytes())
    data[len(data) // 3] ^= 1
    partial.write_bytes(data)
    with pytest.raises(InputError, match=r"out.partial.mcap: damaged: it cannot be continued"):
        replay_team(team(view_every=0.5, state_every=0.5, resolution=0.1), output, resume=True)


class _Attack:
    def __reduce__(self):
        return print, ("attack",)


class _HiddenAttack:
    def __reduce__(self):
        # A function that a module of this package imports.
        return checkpoint.version, ("numpy",)


class _FileAttack:
    def __reduce__(self):
        # A class of this package that creates a file.
        return OutputFile, ("attack",)


@pytest.mark.parametrize("attack", [_Attack(), _HiddenAttack(), _FileAttack(), np.random.seed])
def test_check_points_run_no_code(tmp_path: Path, attack, capsys) -> None:
    output = tmp_path / "out.mcap"
    interrupted_after(2, team(), output)
    body = checkpoint._MAGIC + zstandard.ZstdCompressor().compress(pickle.dumps(attack))
    checkpoint_path(output).write_bytes(body + checkpoint._CHECKSUM.pack(isal_zlib.crc32(body)))
    with pytest.raises(InputError, match="cannot be read by this version") as caught:
        replay_team(team(), output, resume=True)
    assert "is not allowed in a check point" in str(caught.value.__cause__)
    assert "attack" not in capsys.readouterr().out


# --- parts of the state -----------------------------------------------------------------------------------------------


def test_maps_and_their_versions_share_bricks_again(tmp_path: Path) -> None:
    octree = SemanticOctree(0.5, 3)
    octree.find_or_add(np.arange(100))
    snapshot = Snapshot(octree)
    copies = pickle.loads(pickle.dumps((octree, snapshot)))
    assert copies[1].octree is copies[0]
    copies[1].save(np.array([3]))
    copies[0].revisions[3] = 7
    assert copies[1].octree.revisions[3] == 0
    np.testing.assert_array_equal(copies[0].codes, octree.codes)
    assert copies[0].memory_bytes == octree.memory_bytes
