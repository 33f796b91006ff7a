"""The command 'completion', and what it completes."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from click.shell_completion import BashComplete

from octoreplay import cli
from support.command_line import assert_fails, octoreplay


def completions(*words: str) -> list[str]:
    """Return what completes the last of some words of a command line."""
    shell = BashComplete(cli.cli, {}, "octoreplay", "_OCTOREPLAY_COMPLETE")
    return [str(item.value) for item in shell.get_completions(list(words[:-1]), words[-1])]


def test_commands_options_and_words_are_completed() -> None:
    assert completions("comp") == ["compare", "completion"]
    assert completions("run", "--resol") == ["--resolution"]
    assert completions("run", "--rule", "fl") == ["flood"]
    assert completions("experiment", "sc") == ["scale"]


def test_files_with_the_suffix_of_the_argument_are_completed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("a.mcap", "a.bag", "a.txt", "a.yaml"):
        Path(name).touch()
    Path("archive").mkdir()
    assert completions("metrics", "a") == ["a.mcap", "archive/"]
    assert completions("run", "a") == ["a.bag", "a.mcap", "a.yaml", "archive/"]
    assert completions("metrics", "r.mcap", "--csv", "a") == ["a"]


@pytest.mark.parametrize(
    ("shell", "place"),
    [("bash", "data/bash-completion/completions/octoreplay"), ("zsh", "data/zsh/site-functions/_octoreplay"),
     ("fish", "config/fish/completions/octoreplay.fish")],
)  # fmt: skip
def test_the_script_is_printed_or_installed(
    shell: str, place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.setenv("SHELL", f"/usr/bin/{shell}")
    printed = octoreplay("completion")
    assert printed.returncode == 0
    assert f"{shell}_complete" in printed.stdout
    for _ in range(2):
        done = octoreplay("completion", shell, "--install")
        assert done.returncode == 0, done.stderr
        assert f"wrote {tmp_path / place}" in done.stdout
        assert (tmp_path / place).read_text() + "\n" == printed.stdout
    assert ("fpath=(" in done.stdout) == (shell == "zsh")


def test_an_unknown_shell_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SHELL", "/bin/dash")
    assert_fails(2, "'dash' is no shell with completion; give bash, zsh or fish", "completion")


@pytest.mark.long
def test_bash_completes_with_the_printed_script(tmp_path: Path) -> None:
    program = tmp_path / "octoreplay"
    program.write_text(f'#!/bin/sh\nexec {sys.executable} -m octoreplay "$@"\n')
    program.chmod(0o755)
    (tmp_path / "drive.mcap").touch()
    script = (
        'eval "$(octoreplay completion bash)"; COMP_WORDS=(octoreplay metrics dri); COMP_CWORD=2;'
        ' _octoreplay_completion octoreplay; echo "${COMPREPLY[@]}"'
    )
    environment = {**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    done = subprocess.run(
        ["bash", "-c", script], cwd=tmp_path, env=environment, text=True, capture_output=True, check=True
    )
    assert done.stdout == "drive.mcap\n"
