"""Options shared by commands: configuration parameters, paths, and checks of outputs."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import click
from click.shell_completion import CompletionItem

from octoreplay.commands.suggestions import Choice
from octoreplay.config.fields import path_problem
from octoreplay.config.file_url import FileUrl, InputFile, is_url
from octoreplay.config.parameters import PARAMETERS, SECTIONS, Parameter
from octoreplay.config.presets import PRESETS
from octoreplay.errors import ConfigError, OutputError
from octoreplay.io.output_file import FOLDER_LOCK, locked, writing
from octoreplay.records import MAP_KINDS, POSTERIOR

_METAVARS = {"float": "NUMBER", "int": "INTEGER", "floats": "NUMBERS", "str": "WORD"}
"""Placeholders of values in ``--help``, by the kind of the parameter."""


class _PathType(click.Path):
    """Path of a file or folder whose name a file system can hold; it need not exist."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the path; refuse a name that no file can have, and a folder that must not be read."""
        if is_url(value):
            self.fail(f"'{str(value).partition('://')[0]}://...': only logs can be named by URL", param, ctx)
        path = Path(value)
        problem = path_problem(path)
        if problem is None:
            try:
                path.exists()
            except OSError as error:
                problem = str(error.strerror)
        if problem is not None:
            self.fail(f"'{str(path)[:100]}': {problem}", param, ctx)
        return super().convert(value, param, ctx)

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """Return the files with the suffixes in the parameter's placeholder, and folders; all files without any."""
        placeholder = param.metavar or ""
        suffixes = {*re.findall(r"\.[a-z]+\b", placeholder), *(_LOG_SUFFIXES if "LOG" in placeholder else ())}
        start = incomplete.rpartition("/")[2]
        folder = incomplete.removesuffix(start)
        try:
            entries = [entry for entry in sorted(Path(folder or ".").iterdir()) if entry.name.startswith(start)]
        except OSError:
            entries = []
        files = [entry.name for entry in entries if entry.suffix.lower() in suffixes and entry.is_file()]
        if not files:
            # The shell completes folders itself, without a space behind them.
            return super().shell_complete(ctx, param, incomplete)
        folders = [f"{entry.name}/" for entry in entries if entry.is_dir()]
        return [CompletionItem(f"{folder}{name}") for name in (*files, *folders)]


_LOG_SUFFIXES = (".mcap", ".bag", ".db3")
"""Suffixes of logs in files."""


class _LogType(_PathType):
    """Path or URL of a log, or path of a team file."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the path, or the FileUrl; refuse a URL that cannot be read, and that of a team file."""
        if isinstance(value, FileUrl):
            return value
        if not is_url(value):
            return super().convert(value, param, ctx)
        try:
            url = FileUrl(value)
        except ConfigError as error:
            self.fail(str(error), param, ctx)
        if url.suffix.lower() in (".yaml", ".yml"):
            self.fail(f"'{url}': only logs can be named by URL; download the team file", param, ctx)
        return url


existing_path = _PathType(path_type=Path, readable=False)
log_place = _LogType(path_type=Path, readable=False)


_UNITS = {"B": 1, "KB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12, "KIB": 2**10, "MIB": 2**20, "GIB": 2**30}
"""Bytes of each unit, in upper case."""


def parse_size(ctx: click.Context, param: click.Parameter, value: str | None) -> int | None:
    """Return the number of bytes of an option's text such as 500MB, 8GB or 8GiB. Raises BadParameter."""
    if value is None:
        return None
    parts = re.fullmatch(r"([0-9]{1,15}(?:\.[0-9]{0,15})?) ?([A-Za-z]*)", value)
    num_bytes = int(float(parts[1]) * _UNITS.get(parts[2].upper(), 0)) if parts else 0
    if num_bytes < 1:
        raise click.BadParameter(f"'{value}' is not a size such as 500MB or 8GB", ctx, param)
    return num_bytes


preset_option = click.option("--preset", type=Choice(tuple(PRESETS)),
                             help="named set of settings, overridden by options; paper: the paper's experiment, roam:"
                                  " the exchange of the authors' code")  # fmt: skip
map_option = click.option("--map", "map_kind", type=Choice(MAP_KINDS), default=POSTERIOR, show_default=True,
                          help="form of the maps: posterior, h_0 + N (h - h_0), the evidence of the N robots that they"
                               " are the mean of, or this mean h")  # fmt: skip

color_option = click.option(
    "--color", default=None,
    type=click.Choice(("label", "height", "robot", "seen-by", "disagreement", "contradiction", "probability")),
    help="quantity shown by the colours  [default: label, or height for a map with a single class]",
)  # fmt: skip


max_depth_option = click.option(
    "--max-depth", type=click.IntRange(1, 19), default=None,
    help="depth of the finest cells shown, counted from the root as in OctoMap: 19 are the finest of the map, 18 have"
         " twice their edge; a coarse cell is occupied if one of its cells is  [default: 19]",
)  # fmt: skip


def parse_bounds(_: click.Context, __: click.Parameter, value: str | None) -> tuple[float, ...]:
    """Return the numbers of --bounds, none by default, as ``run`` reads them. Raises ConfigError."""
    return () if value is None else PARAMETERS["bounds"].coerce(value)


class _ParameterOption(click.Option):
    """Command line option of a configuration parameter."""

    section = ""
    is_common = True


class RareOption(click.Option):
    """Option that only --help-all shows."""

    is_common = False


class SectionedCommand(click.Command):
    """Command whose help lists the options under the titles of the configuration's sections.

    ``--help`` lists the common ones, ``--help-all`` all.
    """

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        """Return the parameters, with --help-all."""
        return [*super().get_params(ctx), _help_all]

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options, section by section."""
        shows_all = ctx.meta.get(_SHOWS_ALL, False)
        for heading, records in option_groups(self, ctx, common_only=not shows_all).items():
            with formatter.section(heading):
                formatter.write_dl(records)
        rest = sum(not getattr(parameter, "is_common", True) for parameter in self.params)
        if rest and not shows_all:
            formatter.write(f"\n{rest} more options: {ctx.command_path} --help-all\n")


_SHOWS_ALL = "octoreplay.help_all"
"""Name of the flag of --help-all in the context of a command."""


def _show_all(ctx: click.Context, _: click.Parameter, value: bool) -> None:
    """Print the help with all options and end the command, if ``value``."""
    if value and not ctx.resilient_parsing:
        ctx.meta[_SHOWS_ALL] = True
        click.echo(ctx.get_help(), color=ctx.color)
        ctx.exit()


_help_all = click.Option(["--help-all"], is_flag=True, is_eager=True, expose_value=False, callback=_show_all,
                         help="Show all options and exit.")  # fmt: skip


def option_groups(
    command: click.Command, ctx: click.Context, *, common_only: bool = False
) -> dict[str, list[tuple[str, str]]]:
    """Return the options of a command with their help texts, by the titles of the configuration's sections.

    ``common_only`` leaves out those that only --help-all shows.
    """
    groups: dict[str, list[tuple[str, str]]] = {"Options": []}
    for parameter in command.get_params(ctx):
        record = parameter.get_help_record(ctx)
        is_shown = getattr(parameter, "is_common", True) or not common_only
        if record is not None and is_shown and isinstance(parameter, click.Option):
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
        type=Choice(parameter.choices) if parameter.choices else kind,
        default=None,
        help=parameter.help + default,
        metavar=None if parameter.choices else _METAVARS.get(parameter.kind),
    )
    option.section, option.is_common = parameter.section, parameter.is_common
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


_FORCE = "octoreplay.force"
"""Name of the flag of --force in the context of a command."""


def _set_force(ctx: click.Context, _: click.Parameter, value: bool) -> None:
    """Keep the flag for the checks of outputs."""
    ctx.meta[_FORCE] = value


force_option = click.option("--force", is_flag=True, expose_value=False, is_eager=True, callback=_set_force,
                            help="overwrite existing outputs")  # fmt: skip


def _check_new(path: Path, *, is_present: bool) -> None:
    """Raise OutputError for an output that ``is_present``, unless --force is given."""
    if is_present and not click.get_current_context().meta.get(_FORCE, False):
        raise OutputError(f"{path}: already exists; give another name, or use --force to overwrite it")


def check_new_tiles(output: Path) -> None:
    """Check, before any work is done, that no file beside an output has the name of one of its tiles.

    Raises OutputError. With --force they may exist.
    """
    name = re.compile(rf"{re.escape(output.stem)}-(.+-)?x-?[0-9.e+]+_y-?[0-9.e+]+{re.escape(output.suffix)}")
    with writing(output):
        entries = sorted(output.parent.iterdir())
    for entry in entries:
        _check_new(entry, is_present=name.fullmatch(entry.name) is not None)


def check_new_folder(path: Path) -> None:
    """Check, before any work is done, that an output folder is new or empty. Raises OutputError.

    With --force it may hold files.
    """
    check_no_file(path)
    with writing(path):
        is_present = path.exists() and any(entry.name != FOLDER_LOCK for entry in path.iterdir())
    _check_new(path, is_present=is_present)


def lock_folder(path: Path) -> None:
    """Check that an output folder, which the command may continue, is no file, and lock it. Raises OutputError."""
    check_no_file(path)
    click.get_current_context().with_resource(locked(path, is_folder=True, is_awaited=True))


def check_no_file(path: Path) -> None:
    """Raise OutputError for a folder that is a file."""
    with writing(path):
        if path.exists() and not path.is_dir():
            raise OutputError(f"{path}: is a file; name a folder")


def check_output(
    path: Path, suffix: str | Sequence[str], inputs: Sequence[InputFile] = (), *, is_kept: bool = True
) -> None:
    """Check, before any work is done, that an output file can be written, is new and no input, and lock it.

    ``suffix`` is that of its name, or several to choose from. With --force, and without ``is_kept``, it may exist.
    Raises ConfigError for a wrong suffix, OutputError otherwise, also where another process writes the file.
    """
    suffixes = [suffix] if isinstance(suffix, str) else list(suffix)
    with writing(path):
        is_present, is_file = path.exists(), path.is_file()
    if is_present and not is_file:
        raise OutputError(f"{path}: is a folder or a device; use a file name such as out{suffixes[0]}")
    if path.suffix.lower() not in suffixes and not (".yaml" in suffixes and path.suffix.lower() == ".yml"):
        raise ConfigError(f"{path}: the name of the output must end in {' or '.join(suffixes)}")
    if not path.parent.is_dir():
        raise OutputError(f"{path}: cannot be written: the folder '{path.parent}' does not exist")
    if any(path.resolve() == entry.resolve() for entry in inputs):
        raise OutputError(f"{path}: is an input of this command; name another output")
    _check_new(path, is_present=is_present and is_kept)
    click.get_current_context().with_resource(locked(path, is_awaited=True))
