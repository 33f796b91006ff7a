"""Command line: the group of the commands in ``commands/``, and the mapping from errors to exit codes.

Only this module and the commands print or exit. Exit codes: 0 success; 1 input or run error, or a failed check; 2 wrong
usage or configuration; 3 finished, but data or output text was lost; 130 interrupted. Commands import their
dependencies when they run, so that ``--help`` is fast.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Sequence

import click

from octoreplay import interrupts
from octoreplay._version import __version__
from octoreplay.commands import (
    aligning,
    completing,
    data_sets,
    demonstration,
    estimating,
    evaluation,
    experiments,
    labelling,
    last_resort,
    logs,
    page,
    plotting,
    progress,
    recovering,
    refining,
    results,
    running,
    streams,
    studies,
    verdicts,
    viewers,
)
from octoreplay.commands.console import echo
from octoreplay.commands.exit_codes import EXIT_DATA_LOST, EXIT_ERROR, EXIT_INTERRUPTED, EXIT_USAGE
from octoreplay.commands.suggestions import SuggestingGroup, unknown_option
from octoreplay.errors import ConfigError, OctoreplayError, printable
from octoreplay.io.remote_files import show_downloads


@click.group(cls=SuggestingGroup, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(__version__, prog_name="octoreplay")
def cli() -> None:
    """Replay the logs of a robot team into semantic octree maps and run a distributed consensus on them.

    Start with "octoreplay demo". Exit codes: 0 success; 1 input or run error, or a failed check; 2 wrong usage or
    configuration; 3 finished, but data or output text was lost; 130 interrupted.
    """


for _command in (
    running.run, running.simulate, recovering.recover, demonstration.demo, aligning.align, refining.refine,
    estimating.odometry, labelling.label, data_sets.dataset,
    logs.info, logs.init, logs.import_rgbd, logs.import_clouds, page.report, page.view, results.metrics,
    plotting.plot, results.export, results.query, viewers.foxglove_layout, viewers.rviz_config, viewers.rerun,
    evaluation.evaluate, verdicts.check, verdicts.compare, studies.sweep, experiments.experiment,
    completing.completion,
):  # fmt: skip
    cli.add_command(_command)


def main() -> None:
    """Run the command line and exit with its code. From then on signals are ignored."""
    interrupts.install()
    code = _run()
    interrupts.ignore()
    sys.exit(code)


def _run() -> int:
    """Run the command line and return its exit code; every error is one sentence on standard error."""
    streams.protect_streams()
    logging.basicConfig(handlers=[log_handler()])
    logging.getLogger("octoreplay").setLevel(logging.INFO)
    show_downloads(progress.download_bar)
    try:
        code = _exit_code(None)
    except (Exception, KeyboardInterrupt) as error:
        if interrupts.is_received() or isinstance(error, KeyboardInterrupt):
            # Such as the ImportError of a library whose import was interrupted.
            _say("interrupted", error)
            code = EXIT_INTERRUPTED
        else:
            _say(f"error: {last_resort.sentence(error)}", error)
            code = EXIT_ERROR
    if interrupts.is_received() and code in (EXIT_ERROR, EXIT_USAGE):
        code = EXIT_INTERRUPTED
    lost = streams.output_error()
    if lost is not None:
        _say(f"warning: standard output could not be written ({lost.strerror}); files are not affected")
    return EXIT_DATA_LOST if lost is not None and code == 0 else code


def log_handler() -> logging.Handler:
    """Return a handler that prints log messages on standard error, without warnings that a command prints at its end.

    It shows each message once, and escapes in place of characters that would control the terminal.
    """
    handler = logging.StreamHandler()
    handler.addFilter(lambda record: not getattr(record, "is_collected", False))
    handler.addFilter(_Once())
    handler.setFormatter(_EscapingFormatter("%(message)s"))
    return handler


class _EscapingFormatter(logging.Formatter):
    """Formatter that shows characters that would control the terminal as escapes."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the text of a message."""
        return printable(super().format(record))


class _Once(logging.Filter):
    """Filter that passes each message once: a command may open a file several times."""

    def __init__(self) -> None:
        super().__init__()
        self._passed: set[str] = set()

    def filter(self, record: logging.LogRecord) -> bool:
        """Return True for a message that was not passed before."""
        text = record.getMessage()
        is_new = text not in self._passed
        self._passed.add(text)
        return is_new


def _say(text: str, error: BaseException | None = None) -> None:
    """Print one sentence on standard error, with the notes of an exception, such as the place of a partial result."""
    echo("; ".join([text, *getattr(error, "__notes__", ())]), err=True)


_REMOVED_OPTIONS = {
    "--time": "'octoreplay query' takes the time of the map as '--at SECONDS', and a place as '--point X Y Z'",
    "--team-posterior": "the posterior of the team is the default; '--map mean' shows the mean that a robot holds",
    "--max-team-calibration-error": "use '--max-calibration-error', which judges the posterior of the team by default",
}
"""Options of earlier versions, and what to use in their place."""


def _exit_code(arguments: Sequence[str] | None) -> int:
    """Run one command and return its exit code; known errors are reported in one sentence on stderr."""
    try:
        code = cli.main(args=arguments, prog_name="octoreplay", standalone_mode=False)
    except click.ClickException as error:
        if isinstance(error, click.NoSuchOption) and error.option_name in _REMOVED_OPTIONS:
            remedy = _REMOVED_OPTIONS[error.option_name]
            error = click.UsageError(f"No such option '{error.option_name}': {remedy}.", ctx=error.ctx)
        elif isinstance(error, click.NoSuchOption):
            error = unknown_option(error)
        error.show()
        return error.exit_code
    except (KeyboardInterrupt, click.Abort) as error:
        # click raises Abort from a KeyboardInterrupt, and from an EOFError, which is none.
        cause = error.__cause__ or error
        if isinstance(cause, EOFError):
            raise cause from None
        _say(str(cause) or "interrupted", cause)
        return EXIT_INTERRUPTED
    except OctoreplayError as error:
        if interrupts.is_received():
            # Such as the error about a library whose import was interrupted.
            _say("interrupted", error)
            return EXIT_INTERRUPTED
        _say(f"error: {error}", error)
        return EXIT_USAGE if isinstance(error, ConfigError) else EXIT_ERROR
    return code if isinstance(code, int) else 0
