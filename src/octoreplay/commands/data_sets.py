"""Command for public data sets by name: dataset."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from octoreplay.commands.console import prints, terminal
from octoreplay.commands.exit_codes import EXIT_DATA_LOST
from octoreplay.commands.options import check_new_folder, existing_path, force_option
from octoreplay.commands.progress import progress_bar


def _list(ctx: click.Context, _: click.Parameter, value: bool) -> None:
    """Print the names of the data sets and end the command, if ``value``."""
    if value and not ctx.resilient_parsing:
        from octoreplay.io.datasets.catalogue.registry import DATA_SETS

        width = max(map(len, DATA_SETS))
        for name, data_set in DATA_SETS.items():
            click.echo(f"{name:{width}}  {data_set.title}: {data_set.holds}")
        ctx.exit()


@click.command(short_help="Write the team file of a public data set that was downloaded.")
@click.argument("name", metavar="NAME")
@click.argument("folder", type=existing_path, metavar="FOLDER")
@click.option("-o", "--output", type=existing_path, required=True, metavar="DIR", help="folder to write")
@click.option("--every", type=click.IntRange(min=1), default=1, show_default=True,
              help="import every n-th frame of data sets that are folders of images or clouds")  # fmt: skip
@click.option("--list", "is_list", is_flag=True, is_eager=True, expose_value=False, callback=_list,
              help="list the data sets and exit")  # fmt: skip
@force_option
@prints
def dataset(name: str, folder: Path, output: Path, **options: Any) -> int:
    """Write a team file for the files of a public data set in FOLDER, with topics, poses, extrinsics and classes.

    Data sets that are folders of images or clouds are converted to logs. --list shows the names of the data sets.
    """
    from octoreplay.io.datasets.catalogue.prepare import prepare

    check_new_folder(output)
    with progress_bar("import") as update:
        prepared = prepare(name, folder, output, progress=lambda share: update(share, None, ""), **options)
    here = terminal()
    robots = [robot.robot_id for robot in prepared.team.robots]
    here.line(f"wrote {prepared.team_file} ({prepared.title}: {', '.join(robots)})")
    for note in prepared.notes:
        here.note(f"note: {note}")
    missing = [f"robot '{robot}': {text}" for robot, texts in prepared.team.missing.items() for text in texts]
    for sentence in missing:
        here.note(f"missing for a run: {sentence}")
    if prepared.team.num_skipped:
        here.warn(f"{prepared.team.num_skipped:,} frames without a usable pose were skipped")
    if not missing:
        here.line(f"next: octoreplay run {prepared.team_file} -o result.mcap")
    here.give(team_file=prepared.team_file, robots=robots, missing=missing, notes=prepared.notes)
    return EXIT_DATA_LOST if prepared.team.num_skipped else 0
