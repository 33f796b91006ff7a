"""Progress bars of commands, and the warnings after a run."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from octoreplay.commands.console import terminal
from octoreplay.config.file_url import FileUrl
from octoreplay.config.run import RunConfig

if TYPE_CHECKING:
    from octoreplay.records import FrameCounts
    from octoreplay.replay.run import Progress
    from octoreplay.run_metrics import RunSummary


def replay_with_bar(config: RunConfig, output: Path, **options: Any) -> RunSummary:
    """Replay with a progress bar; ``options`` are those of ``replay_team``."""
    from octoreplay.replay.run import replay_team

    with replay_bar() as show:
        return replay_team(config, output, progress=show, **options)


def replay_tiles_with_bar(config: RunConfig, output: Path, edge: float | None, **options: Any) -> RunSummary:
    """Replay in tiles with a progress bar for each stage; ``options`` are those of ``replay_tiles``."""
    from octoreplay.study.tiles.run import replay_tiles

    with progress_bar("replay") as update:

        def show(stage: str, num_done: int, num_all: int) -> None:
            unit = {"cast": "robots", "join": "maps", "write": "ticks"}.get(stage, "tiles")
            update(num_done / num_all, None, f"{stage}: {num_done} of {num_all} {unit}")

        return replay_tiles(config, output, edge, progress=show, **options)


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


@contextlib.contextmanager
def download_bar(file: FileUrl) -> Iterator[Callable[[int, int | None], None]]:
    """Progress bar of a download; gives a callback for the numbers of bytes that are there, and of all."""
    with progress_bar("download") as update:
        yield lambda done, size: update(done / size if size else None, None, file.name)


def simulate_with_bar(folder: Path, options: dict[str, Any]) -> Path:
    """Simulate with a progress bar and report the files written; return the team file."""
    from octoreplay.report.tables import size
    from octoreplay.simulate.settings import SimulationConfig
    from octoreplay.simulate.team import simulate_team

    with progress_bar("simulate") as update:
        config = SimulationConfig(**options)
        summary = simulate_team(folder, config, lambda share: update(share, None, ""))
    images = f"{summary.num_frames:,} {'scans' if config.is_lidar else 'images'}, {size(summary.num_bytes)}"
    terminal().line(f"simulated {len(summary.logs)} robots: {images} in {folder}")
    return summary.team_file


_shown: list[str] = []
"""Titles of the bars on the terminal, which holds one at a time."""


def _ignore(*_: object) -> None:
    """Progress callback without a terminal."""


@contextlib.contextmanager
def progress_bar(title: str) -> Iterator[Callable[[float | None, float | None, str], None]]:
    """Progress bar on stderr if that is a terminal; gives update(finished share, replayed seconds of log, text).

    With --quiet there is none.
    """
    from rich import progress as bars

    from octoreplay.report import tables

    console = tables.terminal(stderr=True)
    # A log that is opened while another bar is shown may be downloaded, also by another thread, which has no context.
    has_room = console.is_terminal and click.get_current_context(silent=True) is not None and not _shown
    if not has_room or terminal().is_quiet:
        yield _ignore
        return
    columns = (
        bars.TextColumn("{task.description}"), bars.BarColumn(bar_width=24), bars.TaskProgressColumn(),
        bars.TimeElapsedColumn(), bars.TextColumn("{task.fields[text]}"),
    )  # fmt: skip
    with bars.Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(title, total=1.0, text="")
        _shown.append(title)

        def update(done: float | None, log_seconds: float | None, text: str) -> None:
            wall = bar.tasks[0].elapsed or 0.0
            speed = f"  {log_seconds / wall:.1f}x real time" if log_seconds is not None and wall > 0.5 else ""
            bar.update(task, completed=done or 0.0, text=text + speed)

        try:
            yield update
        finally:
            _shown.remove(title)


def show_results(summary: RunSummary, *, warnings: Sequence[str] = ()) -> dict[str, Any]:
    """Show the tables of a run, warn of what it reports and of lost data, and return the verdict and the summary.

    ``warnings`` are further sentences that the verdict counts.
    """
    from octoreplay.evaluate.verdict import run_verdict
    from octoreplay.report.tables import results

    here = terminal()
    for sentence in (*summary.warnings, *lost_data(summary.frame_counts), *warnings):
        here.warn(sentence)
    here.show(results(summary, num_warnings=here.num_warnings, is_verbose=here.is_verbose))
    return {"verdict": run_verdict(summary), "summary": summary}


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
        ("no_pose", "had no pose: none within --pose-gap on both sides, or one outside the map's range"),
        ("no_label", "had no labels or confidences within --pair-tolerance"),
        ("late", "were more than --reorder-window late"),
        ("undecodable", "could not be read"),
    ):
        count, first = getattr(counts, cause), counts.first_missing.get(cause)
        if count:
            span = _span(counts, cause)
            yield f"{count:,} of the images or clouds {reason}{span}" + (f"; the first: {first}" if first else "")
    if "leading" in counts.first_missing:
        yield f"images or clouds before the first mapped one: {counts.first_missing['leading']}"
    if "late_pose" in counts.first_missing:
        late = counts.first_missing["late_pose"]
        yield (
            f"poses arrived after the images or clouds that needed them, such as {late}; a larger --reorder-window "
            f"waits for them, or name another pose source for that time"
        )
    if counts.duplicate:
        span = _span(counts, "duplicate")
        yield f"{counts.duplicate:,} images or clouds had the same stamp as another one and were skipped{span}"
    yield from _other_losses(counts)
    for kind, numbers, spelling in (
        ("labels", counts.unknown_label_pixels, "{}"),
        ("colours", counts.unknown_colors, "#{:06x}"),
    ):
        if numbers:
            shown = ", ".join(spelling.format(number) for number in sorted(numbers)[:8])
            more = ", ..." if len(numbers) > 8 else ""
            total = sum(numbers.values())
            what = f"{total:,} pixels or points with {kind} without a class were ignored"
            yield f"{what}: {shown}{more}; --classes gives them one"


def _span(counts: FrameCounts, cause: str, topic: str | None = None) -> str:
    """Clause on the first and last stamp of the messages of a cause; empty in results without them."""
    span = counts.spans.get(topic or counts.sensor_topic, {}).get(cause)
    if span is None:
        return ""
    kind = "log times" if cause in _CAUSES_WITHOUT_STAMP else "stamps"
    return f" ({kind} {span[0] / 1e9:.3f} s to {span[1] / 1e9:.3f} s)"


def _other_losses(counts: FrameCounts) -> Iterator[str]:
    """Sentences on poses and labels that could not be used, and on messages that are not accounted for."""
    for topic, outcomes in counts.messages.items():
        for cause, reason in _CAUSES_WITHOUT_STAMP.items():
            if topic != counts.sensor_topic and cause in outcomes:
                yield f"{outcomes[cause]:,} messages of '{topic}' {reason}{_span(counts, cause, topic)}"
    for topic, number in counts.unaccounted.items():
        yield f"{number:,} messages of '{topic}' are not accounted for; please report this as a defect of octoreplay"


_CAUSES_WITHOUT_STAMP = {
    "undecodable": "could not be read",
    "unusable": "held no pose of finite numbers with a rotation",
}
"""Causes for which a message has no usable stamp, and their reasons."""
