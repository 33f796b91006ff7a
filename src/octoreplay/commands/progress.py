"""Progress bars of commands, and the warnings after a run."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from octoreplay.config.run import RunConfig

if TYPE_CHECKING:
    from rich.console import Console

    from octoreplay.records import FrameCounts
    from octoreplay.replay.run import Progress
    from octoreplay.run_metrics import RunSummary


def replay_with_bar(config: RunConfig, output: Path) -> RunSummary:
    """Replay with a progress bar. An interrupt's message names the partial result."""
    from octoreplay.io.results.result_writer import partial_path
    from octoreplay.replay.run import replay_team

    with replay_bar() as show:
        try:
            return replay_team(config, output, progress=show)
        except KeyboardInterrupt:
            partial = partial_path(output)
            kept = f"; the finished part is in {partial}" if partial.exists() else ""
            raise KeyboardInterrupt(f"interrupted{kept}") from None


@contextlib.contextmanager
def replay_bar() -> Iterator[Callable[[Progress], None]]:
    """Progress bar of a replay; gives a callback for the progress of every tick."""
    with progress_bar("replay") as update:

        def show(progress: Progress) -> None:
            elapsed = progress.log_ns / 1e9
            done = None if not progress.total_ns else min(1.0, progress.log_ns / progress.total_ns)
            stage = f"settling, tick {progress.tick}" if progress.settling else f"{elapsed:.1f} s"
            update(done, None if progress.settling else elapsed, f"{stage}  \u03a6 {progress.total_distance:.3g}")

        yield show


def simulate_with_bar(folder: Path, options: dict[str, Any]) -> Path:
    """Simulate with a progress bar and report the files written; return the team file."""
    from octoreplay.report.tables import size
    from octoreplay.simulate.team import SimulationConfig, simulate_team

    with progress_bar("simulate") as update:
        summary = simulate_team(folder, SimulationConfig(**options), lambda share: update(share, None, ""))
    click.echo(
        f"simulated {len(summary.logs)} robots: {summary.num_frames:,} images, {size(summary.num_bytes)} in {folder}"
    )
    return summary.team_file


def _ignore(*_: object) -> None:
    """Progress callback without a terminal."""


@contextlib.contextmanager
def progress_bar(title: str) -> Iterator[Callable[[float | None, float | None, str], None]]:
    """Progress bar on stderr if that is a terminal; gives update(finished share, replayed seconds of log, text)."""
    from rich import progress as bars

    from octoreplay.report.tables import terminal

    console = terminal(stderr=True)
    if not console.is_terminal:
        yield _ignore
        return
    columns = (
        bars.TextColumn("{task.description}"), bars.BarColumn(bar_width=24), bars.TaskProgressColumn(),
        bars.TimeElapsedColumn(), bars.TextColumn("{task.fields[text]}"),
    )  # fmt: skip
    with bars.Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(title, total=1.0, text="")

        def update(done: float | None, log_seconds: float | None, text: str) -> None:
            wall = bar.tasks[0].elapsed or 0.0
            speed = f"  {log_seconds / wall:.1f}x real time" if log_seconds is not None and wall > 0.5 else ""
            bar.update(task, completed=done or 0.0, text=text + speed)

        yield update


def show_warnings(err: Console, summary: RunSummary, shown: Sequence[str] = ()) -> None:
    """Print a run's warnings, except those ``shown`` before, and the data that each robot's logs lost."""
    for sentence in summary.warnings:
        if sentence not in shown:
            warn(err, sentence)
    for sentence in lost_data(summary.frame_counts):
        warn(err, sentence)


def lost_data(counts_by_robot: Mapping[str, FrameCounts]) -> Iterator[str]:
    """Yield a sentence for each cut file, and for each kind of data of each robot's logs that could not be used."""
    # Robots may share a log.
    yield from dict.fromkeys(s for counts in counts_by_robot.values() for s in counts.truncated_files)
    for robot_id, counts in counts_by_robot.items():
        for sentence in _losses(counts):
            yield f"{robot_id}: {sentence}"


def _losses(counts: FrameCounts) -> Iterator[str]:
    """Sentences on each kind of data of one robot's logs that could not be used."""
    for cause, reason in (
        ("no_pose", "had no pose: none within pose_gap on both sides, or one outside the map's range"),
        ("no_label", "had no labels or confidences within pair_tolerance"),
        ("late", "were more than reorder_window late"),
        ("undecodable", "could not be read"),
    ):
        count, first = getattr(counts, cause), counts.first_missing.get(cause)
        if count:
            yield f"{count:,} of the images or clouds {reason}" + (f"; the first: {first}" if first else "")
    if counts.duplicate:
        yield f"{counts.duplicate:,} images or clouds had the same stamp as another one and were skipped"
    for kind, numbers, spelling in (
        ("labels", counts.unknown_label_pixels, "{}"),
        ("colours", counts.unknown_colors, "#{:06x}"),
    ):
        if numbers:
            shown = ", ".join(spelling.format(number) for number in sorted(numbers)[:8])
            more = ", ..." if len(numbers) > 8 else ""
            total = sum(numbers.values())
            yield f"{total:,} pixels or points with {kind} without a class were ignored: {shown}{more}"


def warn(err: Console, sentence: str) -> None:
    """Print one warning."""
    from rich.text import Text

    err.print(Text.assemble(("warning: ", "yellow"), sentence), soft_wrap=True)
