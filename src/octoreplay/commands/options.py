"""What commands share in their options: configuration parameters, paths, and checks of outputs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from octoreplay.config.parameters import PARAMETERS, SECTIONS, Parameter
from octoreplay.errors import ConfigError, OutputError

_WORDS = {"float": "NUMBER", "int": "INTEGER", "floats": "NUMBERS", "str": "WORD"}
"""What ``--help`` calls the value of a parameter."""

existing_path = click.Path(path_type=Path, readable=False)


class _ParameterOption(click.Option):
    """A command line option made from a configuration parameter."""

    section = ""


class SectionedCommand(click.Command):
    """Lists its options under the headings of the configuration's sections."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options, section by section."""
        for heading, records in option_groups(self, ctx).items():
            with formatter.section(heading):
                formatter.write_dl(records)


def option_groups(command: click.Command, ctx: click.Context) -> dict[str, list[tuple[str, str]]]:
    """Return the options of a command with their help texts, by the titles of the configuration's sections."""
    groups: dict[str, list[tuple[str, str]]] = {"Options": []}
    for parameter in command.get_params(ctx):
        record = parameter.get_help_record(ctx)
        if record is not None and isinstance(parameter, click.Option):
            section = SECTIONS.get(getattr(parameter, "section", ""))
            groups.setdefault(section.title if section else "Options", []).append(record)
    return groups


def _option(parameter: Parameter) -> _ParameterOption:
    """The option of one parameter: ``--name-with-dashes``, without a default, so that only what is given counts."""
    name = parameter.name.replace("_", "-")
    declaration = f"--{name}/--no-{name}" if parameter.kind == "bool" else f"--{name}"
    kind: Any = {"float": float, "int": int, "bool": bool}.get(parameter.kind, str)
    shown = parameter.kind != "bool" and parameter.default not in (None, ())
    default = f"  [default: {parameter.default}]" if shown else ""
    option = _ParameterOption(
        [declaration, parameter.name],
        type=click.Choice(parameter.choices) if parameter.choices else kind,
        default=None,
        help=parameter.help + default,
        metavar=None if parameter.choices else _WORDS.get(parameter.kind),
    )
    option.section = parameter.section
    return option


def with_parameters(command: click.Command) -> click.Command:
    """Add every configuration parameter to a command as an option."""
    command.params.extend(_option(parameter) for parameter in PARAMETERS.values())
    return command


def numbers(name: str, text: str, count: int) -> tuple[float, ...]:
    """So many numbers from text with commas."""
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != count:
        raise ConfigError(f"{name}: expects {count} numbers with commas between them, got '{text}'")
    return numbers


def check_folder(path: Path) -> None:
    """Refuse a folder for figures that is a file, before any work is done."""
    if path.exists() and not path.is_dir():
        raise OutputError(f"{path}: is a file; give a folder")


def check_output(path: Path, suffix: str, inputs: Sequence[Path] = ()) -> None:
    """Refuse an output before any work is done: another kind of file, no file at all, or an input of the command."""
    if path.exists() and not path.is_file():
        raise OutputError(f"{path}: is a folder or a device; give a file name such as out{suffix}")
    if path.suffix.lower() != suffix and not (suffix == ".yaml" and path.suffix.lower() == ".yml"):
        raise ConfigError(f"{path}: the output's name must end in {suffix}")
    if not path.parent.is_dir():
        raise OutputError(f"{path}: cannot be written: the folder '{path.parent}' does not exist")
    if any(path.resolve() == entry.resolve() for entry in inputs):
        raise OutputError(f"{path}: is an input of this command; name another output")
