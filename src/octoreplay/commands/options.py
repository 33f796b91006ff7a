"""Options shared by commands: configuration parameters, paths, and checks of outputs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import click

from octoreplay.config.parameters import PARAMETERS, SECTIONS, Parameter
from octoreplay.config.presets import PRESETS
from octoreplay.errors import ConfigError, OutputError
from octoreplay.records import MAP_KINDS, POSTERIOR

_METAVARS = {"float": "NUMBER", "int": "INTEGER", "floats": "NUMBERS", "str": "WORD"}
"""Placeholders of values in ``--help``, by the kind of the parameter."""

existing_path = click.Path(path_type=Path, readable=False)


preset_option = click.option("--preset", type=click.Choice(tuple(PRESETS)),
                             help="named set of settings, overridden by options; paper: the paper's experiment, roam:"
                                  " the exchange of the authors' code")  # fmt: skip
map_option = click.option("--map", "map_kind", type=click.Choice(MAP_KINDS), default=POSTERIOR, show_default=True,
                          help="form of the maps: posterior, h_0 + N (h - h_0), the evidence of the N robots that they"
                               " are the mean of, or this mean h")  # fmt: skip


class _ParameterOption(click.Option):
    """Command line option of a configuration parameter."""

    section = ""


class SectionedCommand(click.Command):
    """Command whose help lists the options under the titles of the configuration's sections."""

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
    """Option ``--name-with-dashes`` of a parameter; its value is None unless it is given."""
    name = parameter.name.replace("_", "-")
    declaration = f"--{name}/--no-{name}" if parameter.kind == "bool" else f"--{name}"
    kind: Any = {"float": float, "int": int, "bool": bool}.get(parameter.kind, str)
    value = parameter.default
    if parameter.kind == "bool":
        value = name if value else f"no-{name}"
    default = "" if value in (None, ()) else f"  [default: {value}]"
    option = _ParameterOption(
        [declaration, parameter.name],
        type=click.Choice(parameter.choices) if parameter.choices else kind,
        default=None,
        help=parameter.help + default,
        metavar=None if parameter.choices else _METAVARS.get(parameter.kind),
    )
    option.section = parameter.section
    return option


def with_parameters(*sections: str) -> Callable[[click.Command], click.Command]:
    """Decorator that adds an option for every configuration parameter of some sections (default: all) to a command.

    A parameter for which the command has an option of its own gets no other one.
    """

    def add(command: click.Command) -> click.Command:
        own = {option.name for option in command.params}
        chosen = (parameter for parameter in PARAMETERS.values() if not sections or parameter.section in sections)
        command.params.extend(_option(parameter) for parameter in chosen if parameter.name not in own)
        return command

    return add


def numbers(name: str, text: str, count: int) -> tuple[float, ...]:
    """Parse ``count`` numbers separated by commas. Raises ConfigError."""
    try:
        found = tuple(float(part) for part in text.split(","))
    except ValueError:
        found = ()
    if len(found) != count:
        raise ConfigError(f"{name}: expects {count} numbers separated by commas, got '{text}'")
    return found


def check_folder(path: Path) -> None:
    """Check, before any work is done, that the path of an output folder is not a file. Raises OutputError."""
    if path.exists() and not path.is_dir():
        raise OutputError(f"{path}: is a file; name a folder")


force_option = click.option("--force", is_flag=True, help="overwrite existing files")


def check_new(*paths: Path, force: bool) -> None:
    """Check that outputs do not exist, unless ``force`` is set. Raises OutputError."""
    for path in paths:
        if path.exists() and not force:
            raise OutputError(f"{path}: already exists; name another file, or use --force to overwrite it")


def check_output(path: Path, suffix: str, inputs: Sequence[Path] = ()) -> None:
    """Check, before any work is done, that an output file can be written and is not an input of the command.

    Raises ConfigError for a wrong suffix, OutputError otherwise.
    """
    if path.exists() and not path.is_file():
        raise OutputError(f"{path}: is a folder or a device; use a file name such as out{suffix}")
    if path.suffix.lower() != suffix and not (suffix == ".yaml" and path.suffix.lower() == ".yml"):
        raise ConfigError(f"{path}: the name of the output must end in {suffix}")
    if not path.parent.is_dir():
        raise OutputError(f"{path}: cannot be written: the folder '{path.parent}' does not exist")
    if any(path.resolve() == entry.resolve() for entry in inputs):
        raise OutputError(f"{path}: is an input of this command; name another output")
