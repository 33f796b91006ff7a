"""Outputs that exist: every command refuses them, unless --force is given."""

from __future__ import annotations

import shutil
from pathlib import Path

import click
import pytest

from octoreplay import cli
from support.command_line import assert_fails, octoreplay
from support.fixture_paths import PAIR, PAIR_TEAM

CONTINUED = ("simulate", "sweep")
"""Commands with an output folder that they continue, or that must be empty."""


def test_every_command_with_an_output_has_the_option() -> None:
    for name, command in cli.cli.commands.items():
        options = {parameter.name for parameter in command.params if isinstance(parameter, click.Option)}
        if options & {"output", "csv", "plot", "save_team"} and name not in CONTINUED:
            assert "force" in options, name


@pytest.mark.parametrize(
    ("output", "words"),
    [
        ("x.mcap", ("run", PAIR_TEAM, "--settle", 0, "--resolution", 0.8, "-o")),
        ("t.yaml", ("run", PAIR / "husky_1.mcap", "--save-team")),
        ("t.yaml", ("init", PAIR / "husky_1.mcap", "-o")),
        ("m.csv", ("metrics", "r.mcap", "--csv")),
        ("m.ply", ("export", "r.mcap", "-o")),
        ("e.csv", ("evaluate", "r.mcap", "--last", "--csv")),
    ],
)
def test_a_file_is_overwritten_on_request_only(
    output: str, words: tuple[object, ...], pair_result: Path, tmp_path: Path
) -> None:
    shutil.copy(pair_result, tmp_path / "r.mcap")
    old = tmp_path / output
    old.write_text("old")
    refused = octoreplay(*words, output, folder=tmp_path)
    assert refused.returncode == 1
    assert f"error: {output}: already exists; give another name, or use --force to overwrite it" in refused.stderr
    assert old.read_text() == "old"
    done = octoreplay(*words, output, "--force", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert old.read_bytes() != b"old"


def test_a_folder_with_files_is_refused(pair_result: Path, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    assert_fails(1, "already exists; give another name, or use --force", "metrics", pair_result, "--plot", tmp_path)


@pytest.mark.long
def test_figures_are_written_into_an_empty_folder_or_on_request(pair_result: Path, tmp_path: Path) -> None:
    words = ("metrics", pair_result, "--plot", tmp_path)
    assert octoreplay(*words).returncode == 0
    assert_fails(1, "already exists; give another name, or use --force", *words)
    assert octoreplay(*words, "--force").returncode == 0
