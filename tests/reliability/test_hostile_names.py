"""Names with characters that control a terminal: every command shows them as escapes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from ruamel.yaml import YAML

from octoreplay.config.team_file import load_team_file
from octoreplay.config.yaml_file import dump_yaml, load_yaml
from octoreplay.replay.run import replay_team
from support.command_line import octoreplay
from support.fixture_paths import PAIR
from support.long_suite import long

NASTY = "\x1b]0;title\x07\x1b[2J\x9b31m\x00\r\n\u202eevil\u2066\u200f"
"""Sequences of xterm, C0, C1, a line break, and bidirectional characters."""
TEXT = NASTY.replace("\x00", "")
"""The same without NUL, which YAML cannot hold."""
SETTINGS = {"resolution": 1.2, "duration": 1.0, "settle": 1, "evidence_every": 1.0}


def hostile_log(source: Path, target: Path) -> None:
    """Copy a log with other names of topics."""
    with source.open("rb") as file, target.open("wb") as copy:
        writer, channels = Writer(copy), {}
        writer.start("ros2", NASTY)
        for schema, channel, stored in make_reader(file).iter_messages():
            assert schema is not None
            if channel.id not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                topic = f"{channel.topic}{NASTY}"
                channels[channel.id] = writer.register_channel(topic, channel.message_encoding, number)
            writer.add_message(channels[channel.id], stored.log_time, stored.data, stored.publish_time)
        writer.finish()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A team with hostile logs, ids and classes, and its result."""
    folder = tmp_path_factory.mktemp("hostile")
    content = load_yaml((PAIR / "team.yaml").read_text(encoding="utf-8"), "team")
    for number, robot in enumerate(content["robots"]):
        hostile_log(PAIR / robot["log"], folder / robot["log"])
        content["robots"][number] = {"id": f"r{number}{TEXT}", "log": robot["log"]}
    for entry in content["classes"]:
        entry["name"] += f"{TEXT}$\\frac$"
    (folder / "team.yaml").write_text(dump_yaml(content), encoding="utf-8")
    replay_team(load_team_file(folder / "team.yaml").with_parameters(SETTINGS), folder / "result.mcap")
    return folder


def check(*arguments: object, folder: Path, shows_names: bool = True) -> None:
    """Run a command and check what it shows."""
    done = octoreplay(*arguments, folder=folder)
    shown = done.stdout + done.stderr
    assert all(character.isprintable() or character == "\n" for character in shown), ascii(shown)
    assert not shows_names or "\\x1b" in shown, shown


COMMANDS = {
    "info": ("info", "husky_1.mcap"),
    "query": ("query", "result.mcap", "--point", 0, 0, 0, "--box", -9, -9, -9, 9, 9, 9),
    "unknown robot": ("query", "result.mcap", "--point", 0, 0, 0, "--robot", NASTY.replace("\x00", "")),
    "metrics": ("metrics", "result.mcap"),
    "check": ("check", "result.mcap", "--max-label-disagreement", "0"),
    "compare": ("compare", "result.mcap", "result.mcap"),
    "evaluate": ("evaluate", "result.mcap", "-v"),
}
QUIET = ("check", "compare")
"""Commands whose output names neither robots nor classes here."""


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_shows_hostile_names_as_escapes(folder: Path, name: str) -> None:
    check(*COMMANDS[name], folder=folder, shows_names=name not in QUIET)


@long
def test_other_commands_show_hostile_names_as_escapes(folder: Path, tmp_path: Path) -> None:
    check("init", "husky_1.mcap", "-o", tmp_path / "t.yaml", folder=folder, shows_names=False)
    assert load_team_file(tmp_path / "t.yaml").robots[0].depth_topic == f"/husky_1/camera/depth/image_raw{NASTY}"
    check("run", "husky_1.mcap", "-o", tmp_path / "o.mcap", "--resolution", 2, "--duration", 1, folder=folder)
    check("run", "team.yaml", "-o", tmp_path / "o2.mcap", "--resolution", 2, "--duration", 1, folder=folder)
    check("run", "--config-from", "result.mcap", "-o", tmp_path / "p.mcap", folder=folder)
    check("align", "team.yaml", "-o", tmp_path / "a.yaml", "--resolution", 1, folder=folder)
    check("export", "result.mcap", "-o", tmp_path / "m.ply", folder=folder, shows_names=False)
    check("evaluate", "result.mcap", "--truth", PAIR, "--plot", tmp_path / "e", folder=folder)
    check("metrics", "result.mcap", "--plot", tmp_path / "p", "--csv", tmp_path / "m.csv", folder=folder)
    check("refine", "team.yaml", "-o", tmp_path / "r.yaml", folder=folder, shows_names=False)
    check("sweep", "team.yaml", "--vary", "network_seed=1", "-o", tmp_path / "s", folder=folder, shows_names=False)
    check("run", "team.yaml", "-o", tmp_path / f"no{TEXT}" / "o.mcap", folder=folder)


@long
def test_files_for_viewers_hold_hostile_names(folder: Path, tmp_path: Path) -> None:
    names = [f"r{number}{TEXT}" for number in range(2)]
    check("foxglove-layout", "result.mcap", "-o", tmp_path / "l.json", folder=folder, shows_names=False)
    check("rviz-config", "result.mcap", "-o", tmp_path / "v.rviz", folder=folder, shows_names=False)
    check("rerun", "result.mcap", "-o", tmp_path / "o.rrd", folder=folder, shows_names=False)
    view = json.loads((tmp_path / "l.json").read_text(encoding="utf-8"))["configById"]["3D!maps"]
    assert {f"/{name}/map" for name in names} <= view["topics"].keys()
    yaml = YAML(typ="safe", pure=True)
    displays = yaml.load(tmp_path / "v.rviz")["Visualization Manager"]["Displays"]
    assert {f"/{name}/map" for name in names} <= {entry.get("Topic", {}).get("Value") for entry in displays}
    assert {f"/{name}/map" for name in names} <= yaml.load(tmp_path / "v.qos.yaml").keys()
    assert (tmp_path / "o.rrd").stat().st_size > 0
