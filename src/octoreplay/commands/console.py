"""Output of one command: tables and lines for people, one JSON document for programs, and the warnings at the end."""

from __future__ import annotations

import contextlib
import functools
import logging
import time
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

import click

from octoreplay.errors import printable

if TYPE_CHECKING:
    from rich.console import Console, RenderableType

_KEY = "octoreplay.terminal"
"""Name of the terminal in the context of a command."""


def echo(text: str, *, err: bool = False) -> None:
    """Print one sentence on stdout or stderr; characters that would control the terminal are shown as escapes."""
    click.echo(printable(text), err=err)


class Terminal:
    """Output of one command.

    Tables and lines go to stdout, or to stderr with ``is_json``, and are left out with ``is_quiet``. Warnings go to
    stderr, each once, when the command ends.
    """

    def __init__(self, *, is_json: bool = False, is_quiet: bool = False, is_verbose: bool = False) -> None:
        self.is_quiet = is_quiet
        self.is_verbose = is_verbose
        self._is_json = is_json
        self._warnings: dict[str, None] = {}
        self._printed: set[str] = set()
        self._document: Mapping[str, Any] = {}

    @functools.cached_property
    def _console(self) -> Console:
        """Console of the tables."""
        from octoreplay.report.tables import terminal

        return terminal(stderr=self._is_json)

    def show(self, *parts: RenderableType) -> None:
        """Print tables, with an empty line after each."""
        if not self.is_quiet:
            from octoreplay.report.tables import show

            show(self._console, *parts)

    def line(self, text: str) -> None:
        """Print one sentence."""
        if not self.is_quiet:
            echo(text, err=self._is_json)

    def text(self, text: str) -> None:
        """Print a text of octoreplay itself, such as a script, as it is."""
        if not self.is_quiet:
            click.echo(text, err=self._is_json)

    def note(self, text: str) -> None:
        """Print one sentence that is no result on stderr."""
        if not self.is_quiet:
            echo(text, err=True)

    def warn(self, sentence: str, *, is_printed: bool = False) -> None:
        """Keep a warning for the JSON document and, unless it is printed already, for the end of the command."""
        self._warnings[sentence] = None
        if is_printed:
            self._printed.add(sentence)

    @property
    def num_warnings(self) -> int:
        """Number of different warnings up to now."""
        return len(self._warnings)

    def give(self, **document: Any) -> None:
        """Set the contents of the JSON document, of which stdout gets nothing else with ``--json``."""
        self._document = document

    def show_warnings(self) -> None:
        """Print the warnings that are not printed already."""
        sentences = [sentence for sentence in self._warnings if sentence not in self._printed]
        if sentences:
            from rich.text import Text

            from octoreplay.report.tables import terminal

            err = terminal(stderr=True)
            for sentence in sentences:
                err.print(Text.assemble(("warning: ", "yellow"), printable(sentence)), soft_wrap=True)

    def show_document(self, command: str) -> None:
        """Print the JSON document with ``--json``: ``command``, the contents, ``warnings``."""
        if self._is_json:
            from octoreplay.io.text_files import json_text

            click.echo(json_text({"command": command, **self._document, "warnings": list(self._warnings)}), nl=False)


def terminal() -> Terminal:
    """Return the output of the command that runs."""
    found: Terminal = click.get_current_context().meta[_KEY]
    return found


class _Collector(logging.Handler):
    """Handler that passes logged warnings to the terminal of a command.

    Handlers of loggers further up see ``is_collected`` on a record that the terminal prints at the end.
    """

    def __init__(self, here: Terminal) -> None:
        super().__init__(logging.WARNING)
        self._here = here

    def emit(self, record: logging.LogRecord) -> None:
        """Keep a warning; those logged with ``errors.EARLY`` are left to the other handlers too."""
        is_early = getattr(record, "is_early", False)
        self._here.warn(record.getMessage().removeprefix("warning: "), is_printed=is_early)
        record.is_collected = not is_early


@contextlib.contextmanager
def _collected(here: Terminal) -> Iterator[None]:
    """Collect the warnings that the package logs in the body."""
    logger, collector = logging.getLogger("octoreplay"), _Collector(here)
    logger.addHandler(collector)
    try:
        yield
    finally:
        logger.removeHandler(collector)


def prints(function: Callable[..., int]) -> Callable[..., int]:
    """Decorator that gives a command its ``terminal``, with the options --json, --quiet and --verbose."""

    @click.option("--json", "is_json", is_flag=True, help="print one JSON document on stdout; tables go to stderr")
    @click.option("-q", "--quiet", "is_quiet", is_flag=True, help="print no tables and no progress, only warnings")
    @click.option("-v", "--verbose", "is_verbose", is_flag=True,
                  help="print all rows of tables, log-odds of places, and the time taken")  # fmt: skip
    @functools.wraps(function)
    def command(*arguments: Any, is_json: bool, is_quiet: bool, is_verbose: bool, **options: Any) -> int:
        if is_quiet and is_verbose:
            raise click.UsageError("--quiet and --verbose exclude each other")
        context, start = click.get_current_context(), time.monotonic()
        here = context.meta[_KEY] = Terminal(is_json=is_json, is_quiet=is_quiet, is_verbose=is_verbose)
        try:
            with _collected(here):
                code = function(*arguments, **options)
        finally:
            here.show_warnings()
        here.show_document(context.command_path.partition(" ")[2])
        if is_verbose:
            here.note(f"took {time.monotonic() - start:.1f} s")
        return code

    return command
