"""Command that prints or installs the completion of the command line: completion."""

from __future__ import annotations

import os
from pathlib import Path

import click

from octoreplay.commands.console import prints, terminal
from octoreplay.commands.suggestions import Choice
from octoreplay.io.output_file import write_whole, writing

_PROGRAM = "octoreplay"
_VARIABLE = "_OCTOREPLAY_COMPLETE"


def _places() -> dict[str, Path]:
    """Files from which each shell loads the completion."""
    home = Path.home()
    data = Path(os.environ.get("XDG_DATA_HOME") or home / ".local" / "share")
    config = Path(os.environ.get("XDG_CONFIG_HOME") or home / ".config")
    return {
        "bash": data / "bash-completion" / "completions" / _PROGRAM,
        "zsh": data / "zsh" / "site-functions" / f"_{_PROGRAM}",
        "fish": config / "fish" / "completions" / f"{_PROGRAM}.fish",
    }


@click.command(short_help="Print or install the completion of commands, options and files for a shell.")
@click.argument("shell", type=Choice(("bash", "zsh", "fish")), required=False)
@click.option("--install", is_flag=True, help="write the script to the place from which the shell loads it")
@prints
def completion(shell: str | None, install: bool) -> int:
    """Print the script that completes commands, options and files in a shell (default: that of $SHELL).

    With --install the script is written where the shell loads it: bash with the package bash-completion and fish find
    it by themselves, zsh needs one line in ~/.zshrc, which is printed.
    """
    from click.shell_completion import get_completion_class

    shell = shell or Path(os.environ.get("SHELL", "")).name
    kind = get_completion_class(shell) if shell in _places() else None
    if kind is None:
        raise click.UsageError(f"'{shell}' is no shell with completion; give bash, zsh or fish")
    script = kind(click.get_current_context().find_root().command, {}, _PROGRAM, _VARIABLE).source()
    here = terminal()
    if not install:
        here.text(script)
        here.give(shell=shell, script=script)
        return 0
    path = _places()[shell]
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, script)
    here.line(f"wrote {path}; it is used in new shells")
    if shell == "zsh":
        here.line(f"add this to ~/.zshrc before compinit: fpath=({path.parent} $fpath)")
    here.give(shell=shell, written=[path])
    return 0
