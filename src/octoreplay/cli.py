"""Command line: the group of the commands in ``commands/``, and the mapping from errors to exit codes.

Only this module and the commands print or exit. Exit codes: 0 success; 1 input or run error, or a failed check; 2 wrong
usage or configuration; 3 finished, but data was lost; 130 interrupted. Commands import their dependencies when they
run, so that ``--help`` is fast.
"""

from __future__ import annotations

import logging
import signal
import sys
from collections.abc import Sequence

import click

from octoreplay._version import __version__
from octoreplay.commands import (
    aligning,
    demonstration,
    evaluation,
    experiments,
    logs,
    refining,
    results,
    running,
    studies,
    verdicts,
)
from octoreplay.commands.exit_codes import EXIT_ERROR, EXIT_INTERRUPTED, EXIT_USAGE
from octoreplay.errors import ConfigError, OctoreplayError


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(__version__, prog_name="octoreplay")
def cli() -> None:
    """Replay the logs of a robot team into semantic octree maps and run a distributed consensus on them.

    Start with "octoreplay demo". Exit codes: 0 success; 1 input or run error, or a failed check; 2 wrong usage or
    configuration; 3 finished, but data was lost; 130 interrupted.
    """


for _command in (
    running.run, running.simulate, demonstration.demo, aligning.align, refining.refine, logs.info, logs.init,
    logs.import_rgbd, logs.import_clouds, results.metrics, results.export, results.query, evaluation.evaluate,
    verdicts.check, verdicts.compare, studies.sweep, experiments.experiment,
):  # fmt: skip
    cli.add_command(_command)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and exit with its code. SIGTERM has the same effect as Ctrl-C."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    logging.basicConfig(format="%(message)s")
    logging.getLogger("octoreplay").setLevel(logging.INFO)
    sys.exit(_exit_code(arguments))


_REMOVED_OPTIONS = {
    "--team-posterior": "the posterior of the team is the default; '--map mean' shows the mean that a robot holds",
    "--max-team-calibration-error": "use '--max-calibration-error', which judges the posterior of the team by default",
}
"""Options of earlier versions, and what to use in their place."""


def _exit_code(arguments: Sequence[str] | None) -> int:
    """Run one command and return its exit code; errors are reported in one sentence on stderr."""
    try:
        code = cli.main(args=arguments, prog_name="octoreplay", standalone_mode=False)
    except click.ClickException as error:
        if isinstance(error, click.NoSuchOption) and error.option_name in _REMOVED_OPTIONS:
            remedy = _REMOVED_OPTIONS[error.option_name]
            error = click.UsageError(f"No such option '{error.option_name}': {remedy}.", ctx=error.ctx)
        error.show()
        return error.exit_code
    except (KeyboardInterrupt, click.Abort) as error:
        # click raises Abort from a KeyboardInterrupt.
        click.echo(str(error) or str(error.__cause__ or "") or "interrupted", err=True)
        return EXIT_INTERRUPTED
    except ConfigError as error:
        click.echo(f"error: {error}", err=True)
        return EXIT_USAGE
    except OctoreplayError as error:
        click.echo(f"error: {error}", err=True)
        return EXIT_ERROR
    return code if isinstance(code, int) else 0
