"""Command that finds the frames of a team: align."""

from __future__ import annotations

import dataclasses
import glob
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from octoreplay.commands.console import prints, terminal
from octoreplay.commands.exit_codes import EXIT_DATA_LOST, EXIT_ERROR
from octoreplay.commands.options import (
    SectionedCommand,
    check_new_folder,
    check_output,
    existing_path,
    force_option,
    lock_folder,
    log_place,
    with_parameters,
)
from octoreplay.commands.progress import lost_data, progress_bar
from octoreplay.commands.suggestions import Choice
from octoreplay.commands.team_options import base_config, save_team_file
from octoreplay.config.class_file import with_classes
from octoreplay.config.class_tables.label_rows import BUILT_IN
from octoreplay.config.file_url import InputFile
from octoreplay.errors import ConfigError

if TYPE_CHECKING:
    from octoreplay.config.resolved import ResolvedRun
    from octoreplay.config.run import RunConfig
    from octoreplay.io.robots.survey import LogSurveys
    from octoreplay.records import FrameCounts
    from octoreplay.replay.alignment import Alignment
    from octoreplay.replay.own_maps import OwnEvidence


def dof_option(kind: type[click.Option] = click.Option) -> Callable[[Any], Any]:
    """Return the option --dof as an option of a class."""
    return click.option("--dof", cls=kind, type=Choice(("4", "6")), default=None,
                        help="unknowns of a frame: 4 if the z axes of all map frames are vertical; 6 if not, as for"
                             " hand-held cameras  [default: 4]")  # fmt: skip


@with_parameters("sensor", "map", "time")
@click.command(cls=SectionedCommand, short_help="Find the frames of a team from its robots' maps.")
@click.argument("inputs", nargs=-1, required=True, type=log_place, metavar="TEAM.yaml | LOG... | RESULT.mcap")
@click.option("-o", "--output", type=existing_path, required=True, metavar="ALIGNED.yaml", help="team file to write")
@dof_option()
@click.option("--guess", type=existing_path, metavar="FRAMES.yaml",
              help="transforms T_team_map to try, which are used only where the maps verify them")  # fmt: skip
@click.option("--components", is_flag=True,
              help="write further components of aligned robots to team files too (ALIGNED-2.yaml, ...)")  # fmt: skip
@click.option("--csv", type=existing_path, metavar="FILE.csv", help="write the numbers of all pairs as CSV")
@click.option("--plot", type=existing_path, metavar="DIR",
              help="write pictures of the maps before and after into this folder")  # fmt: skip
@click.option("--classes", metavar="NAME|FILE",
              help=f"class table that gives the meaning of labels: {', '.join(BUILT_IN)}, or a file")  # fmt: skip
@force_option
@prints
def align(
    inputs: tuple[InputFile, ...], output: Path, dof: str | None, guess: Path | None, components: bool,
    csv: Path | None, plot: Path | None, classes: str | None, **parameters: Any,
) -> int:  # fmt: skip
    """Find the frames of a team: each robot's T_team_map, from the overlap of the robots' own maps.

    Writes the team file again with the frames, their standard deviations and their origins. Robots that no accepted
    pair connects are named and left out. Exit code 0 if all robots are connected and no given T_team_map contradicts
    the maps; else 1, and no team file is written if no two robots are connected. Exit code 3: all robots are connected,
    but data of the logs was lost.
    """
    for path, suffix in {output: ".yaml", **({csv: ".csv"} if csv else {})}.items():
        check_output(path, suffix, [*inputs, *([guess] if guess else [])])
    further = sorted(output.parent.glob(f"{glob.escape(output.stem)}-[0-9]*{output.suffix}")) if components else []
    for path in further:
        check_output(path, ".yaml")
    if plot is not None:
        check_new_folder(plot)
        lock_folder(plot)

    from octoreplay.report.alignment_files import alignment_content, write_alignment
    from octoreplay.report.alignment_plots import write_alignment_figures
    from octoreplay.report.alignment_tables import alignment_tables

    here = terminal()
    given = {name: value for name, value in parameters.items() if value is not None}
    config, alignment, warnings, counts = _aligned(inputs, int(dof or 4), guess, classes, given)
    here.show(alignment_tables(alignment))
    written = write_alignment(alignment, csv) if csv is not None else []
    written += write_alignment_figures(alignment, plot) if plot is not None else []
    for sentence in (*warnings, *lost_data(counts), *alignment.warnings):
        here.warn(sentence)
    written = [*_write_teams(config, alignment, output, components=components), *written]
    for path in written:
        here.line(f"wrote {path}")
    here.give(is_whole=alignment.is_whole, **alignment_content(alignment), written=written)
    if not alignment.is_whole:
        return EXIT_ERROR
    return EXIT_DATA_LOST if any(count.lost_data for count in counts.values()) else 0


def evidence_with_bar(config: ResolvedRun) -> list[OwnEvidence]:
    """Map the robots of a team in their own frames, with a progress bar."""
    from octoreplay.replay.own_maps import own_evidences

    with progress_bar("map") as update:
        return own_evidences(config, progress=lambda share: update(share, None, ""))


def align_with_bar(
    config: RunConfig,
    evidence: Sequence[OwnEvidence],
    dof: int = 4,
    guesses: Mapping[str, Sequence[float]] | None = None,
) -> Alignment:
    """Align the robots of a configuration from the evidence in their own frames, with a progress bar."""
    from octoreplay.replay.alignment import align_evidence

    with progress_bar("align") as update:
        return align_evidence(
            config, evidence, dof=dof, guesses=guesses, progress=lambda share: update(share, None, "")
        )


def aligned_run(chosen: RunConfig, dof: int, surveys: LogSurveys) -> tuple[ResolvedRun, Alignment]:
    """Align the robots of a configuration, show the tables, and return the aligned run, resolved, with the alignment.

    Raises InputError where no two robots are connected.
    """
    from octoreplay.io.robots import discover
    from octoreplay.replay.alignment import aligned_config, check_alignable, check_aligned
    from octoreplay.report.alignment_tables import alignment_tables

    check_alignable(chosen, {})
    # Frames that nothing relates are the reason to align them.
    resolved = discover.resolve(chosen.with_parameters({"strict_frames": False}), surveys)
    alignment = align_with_bar(chosen, evidence_with_bar(resolved), dof)
    terminal().show(alignment_tables(alignment))
    check_aligned(alignment)
    config = discover.resolve(aligned_config(chosen, alignment.teams[0]), surveys)
    return dataclasses.replace(config, warnings=(*config.warnings, *alignment.warnings)), alignment


def _aligned(
    inputs: tuple[InputFile, ...], dof: int, guess: Path | None, classes: str | None, given: Mapping[str, Any]
) -> tuple[RunConfig, Alignment, tuple[str, ...], Mapping[str, FrameCounts]]:
    """The configuration of the inputs, the alignment of its robots, and warnings and counts of the logs."""
    from octoreplay.config.frames_file import load_frames_file
    from octoreplay.io.results.result_reader import is_result
    from octoreplay.io.robots import discover
    from octoreplay.io.robots.survey import LogSurveys
    from octoreplay.replay.alignment import aligned_config, check_alignable

    guesses = None if guess is None else load_frames_file(guess)
    if isinstance(inputs[0], Path) and is_result(inputs[0]):
        if len(inputs) > 1:
            raise click.UsageError(f"name one result alone, without {inputs[1]}")
        if given or classes is not None:
            raise ConfigError(f"{inputs[0]}: holds finished maps; leave out {_option(given)}, or name its logs")
        return (*_aligned_result(inputs[0], dof, guesses), (), {})
    with LogSurveys() as surveys:
        config = base_config(inputs, None, surveys)
        config = (config if classes is None else with_classes(config, classes)).with_parameters(given)
        check_alignable(config, guesses or {})
        resolved = discover.resolve(config.with_parameters({"strict_frames": False}), surveys)
        evidence = evidence_with_bar(resolved)
        alignment = align_with_bar(config, evidence, dof, guesses)
        warnings = discover.resolve(aligned_config(config, alignment.teams[0]), surveys).warnings
        counts = {robot.robot_id: own.counts for robot, own in zip(config.robots, evidence, strict=True)}
        return config, alignment, warnings, counts


def _option(given: Mapping[str, Any]) -> str:
    """The first option that was given."""
    return f"--{next(iter(given), 'classes').replace('_', '-')}"


def _aligned_result(path: Path, dof: int, guesses: Mapping[str, Sequence[float]] | None) -> tuple[RunConfig, Alignment]:
    """The configuration of a result, and the alignment of its robots from their stored evidence."""
    from octoreplay.replay.alignment import align_robots, stored_maps
    from octoreplay.result import open_result

    with open_result(path) as result, progress_bar("align") as update:
        maps, T_map_own = stored_maps(result)
        return result.config, align_robots(
            result.config,
            maps,
            dof=dof,
            T_map_own=T_map_own,
            guesses=guesses,
            progress=lambda share: update(share, None, ""),
        )


def _write_teams(config: RunConfig, alignment: Alignment, output: Path, *, components: bool) -> list[Path]:
    """Write the team file, and with ``components`` those of further teams; return the files."""
    from octoreplay.replay.alignment import aligned_config, check_aligned

    check_aligned(alignment)
    teams = [team for team in alignment.teams if len(team) > 1]
    written = []
    for number, team in enumerate(teams if components else teams[:1], start=1):
        path = output if number == 1 else output.with_stem(f"{output.stem}-{number}")
        save_team_file(aligned_config(config, team), path)
        written.append(path)
    return written
