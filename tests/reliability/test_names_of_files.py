"""Names that no file can have: too long, not UTF-8, with NUL; and paths given as text."""

from __future__ import annotations

from pathlib import Path

import click
import pytest

import octoreplay
from octoreplay.cli import cli
from octoreplay.config.robot import RobotConfig
from octoreplay.config.team_file import parse_team
from octoreplay.errors import ConfigError, InputError
from octoreplay.io.containers.fingerprint import log_files
from support.command_line import octoreplay as command
from support.fixture_paths import FIXTURES, PAIR_TEAM

LONG = "x" * 300
DEEP = "/".join(["d" * 200] * 30)
NAMES = (LONG, DEEP, "a\udcff")


def path_options() -> list[tuple[str, str]]:
    """Each command with each of its options and arguments that are paths."""
    found = []
    for name, one in cli.commands.items():
        ends = one.commands.items() if isinstance(one, click.Group) else [("", one)]
        for inner, end in ends:
            found += [(f"{name} {inner}".strip(), p.name or "") for p in end.params if isinstance(p.type, click.Path)]
    return found


@pytest.mark.parametrize(("name", "option"), path_options())
@pytest.mark.parametrize("path", NAMES, ids=["long", "deep", "not UTF-8"])
def test_every_command_refuses_names_that_no_file_can_have(name: str, option: str, path: str) -> None:
    words = name.split()
    found: click.Command = cli
    for word in words:
        assert isinstance(found, click.Group)
        found = found.commands[word]
    parameter = next(p for p in found.params if p.name == option)
    with pytest.raises(click.BadParameter, match="its name is "):
        parameter.type.convert(path, parameter, None)


def test_the_sentence_is_short_and_names_the_remedy(tmp_path: Path) -> None:
    done = command("query", tmp_path / LONG, "--point", 0, 0, 0)
    assert done.returncode == 2
    assert "its name is longer than 255 bytes" in done.stderr
    assert len(done.stderr) < 600
    done = command("run", PAIR_TEAM, "-o", tmp_path / f"{'x' * 245}.mcap")
    assert done.returncode == 1
    assert "cannot be written" in done.stderr


@pytest.mark.parametrize("path", [LONG, DEEP, "a\\0b"], ids=["long", "deep", "NUL"])
@pytest.mark.parametrize("key", ["log", "pose_file"])
def test_team_files_with_such_names_are_refused(key: str, path: str) -> None:
    entry = {"log": "a.mcap"} | {key: path}
    text = "robots:\n- {id: r, " + ", ".join(f'{name}: "{value}"' for name, value in entry.items()) + "}\n"
    with pytest.raises(ConfigError, match=r"team: robot 'r': '.*': its name"):
        parse_team(text, name="team", folder=Path())
    with pytest.raises(ConfigError, match="neither a file nor a built-in table"):
        parse_team(f'robots: [{{id: r, log: a}}]\nclasses: "{path}"', name="team", folder=Path())


def test_files_of_a_folder_with_such_names_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a\udcff").write_bytes(b"")
    with pytest.raises(InputError, match="not UTF-8; rename it"):
        log_files(tmp_path)


def test_paths_may_be_text(tmp_path: Path) -> None:
    robot = RobotConfig("r", ("a.mcap", "b.mcap"), pose_file="p.txt")  # type: ignore[arg-type] - paths as text
    assert robot.logs == (Path("a.mcap"), Path("b.mcap"))
    assert robot.pose_file == Path("p.txt")
    assert [found.robot_id for found in octoreplay.discover([str(FIXTURES / "pair" / "husky_1.mcap")])] == ["husky_1"]
    output = str(tmp_path / "a.ply")
    assert sum(octoreplay.export_map(str(FIXTURES / "result_3.mcap"), output).values()) > 0
    config = octoreplay.load_team_file(str(PAIR_TEAM)).with_parameters({"resolution": 2.0, "duration": 1.0})
    octoreplay.replay_team(config, str(tmp_path / "o.mcap"))
    with octoreplay.open_result(str(tmp_path / "o.mcap")) as result:
        assert result.is_complete
