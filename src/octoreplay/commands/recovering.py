"""Command that recovers the result of a run that was killed: recover."""

from __future__ import annotations

from pathlib import Path

import click

from octoreplay.commands.console import prints, terminal
from octoreplay.commands.exit_codes import EXIT_DATA_LOST
from octoreplay.commands.options import check_output, existing_path, force_option


@click.command(short_help="Make a finished file of an unfinished result.")
@click.argument("partial", type=existing_path, metavar="OUT.partial.mcap")
@click.option("-o", "--output", type=existing_path, metavar="FILE.mcap",
              help="result to write  [default: OUT.recovered.mcap]")  # fmt: skip
@force_option
@prints
def recover(partial: Path, output: Path | None) -> int:
    """Make a finished file of the result of a run that was killed or cut off by a power failure.

    Every part of OUT.partial.mcap that was written completely is copied. The file is marked as incomplete. Exit code 3
    where parts before the end are damaged.
    """
    from octoreplay.io.results.recovery import recover_result
    from octoreplay.io.results.unfinished import PARTIAL_SUFFIX
    from octoreplay.report.tables import size

    output = output or partial.with_name(f"{partial.name.removesuffix(PARTIAL_SUFFIX)}.recovered.mcap")
    check_output(output, ".mcap", [partial])
    found = recover_result(partial, output)
    here = terminal()
    here.line(f"wrote {output} ({found.num_messages:,} messages, {size(output.stat().st_size)})")
    here.line(f"incomplete: the run did not finish, and its result {found.extent}")
    for clause in found.damage:
        here.warn(f"{partial}: {clause}")
    here.give(written=[output], num_messages=found.num_messages, extent=found.extent, is_damaged=found.is_damaged)
    return EXIT_DATA_LOST if found.is_damaged else 0
