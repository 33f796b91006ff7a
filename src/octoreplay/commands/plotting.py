"""Command that draws figures of results: plot."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Any

import click

from octoreplay.commands.console import prints, terminal
from octoreplay.commands.options import check_output, color_option, existing_path, force_option, max_depth_option
from octoreplay.commands.suggestions import Choice
from octoreplay.errors import ConfigError


@click.command(short_help="Draw a figure of one result or several: disagreement, packets, agreement, map and others.")
@click.argument("results", type=existing_path, metavar="A.mcap [B.mcap ...]", nargs=-1, required=True)
@click.option("--what", required=True, metavar="FIGURE",
              type=Choice(("phi", "packets", "agreement", "coverage", "links", "contradiction", "map")),
              help="phi, packets, agreement, coverage, links, contradiction or map")  # fmt: skip
@click.option("-o", "--output", type=existing_path, required=True, metavar="FILE",
              help="file to write: .pdf, .png or .svg")  # fmt: skip
@click.option("--label", "labels", multiple=True, metavar="TEXT",
              help="label of a result, once for each in their order  [default: the names of the files]")  # fmt: skip
@click.option("--style", type=Choice(("screen", "one-column", "two-column", "talk")), default="screen",
              show_default=True, help="size and fonts: paper columns of 3.5 in or 7.16 in, or slides")  # fmt: skip
@click.option("--robot", default=None, metavar="ID", help="robot of a map, or 'central'  [default: the first robot]")
@click.option("--at", type=float, default=None, metavar="SECONDS",
              help="time of a map since the run's start [s]  [default: the end]")  # fmt: skip
@color_option
@max_depth_option
@force_option
@prints
def plot(results: tuple[Path, ...], what: str, output: Path, labels: tuple[str, ...], style: str, **of_map: Any) -> int:
    """Draw one figure of one result, or of several results over each other.

    Curves of several robots are the mean with the standard deviation as a band. The light grey band is settling, which
    begins where the logs end.
    """
    given = [name for name, value in of_map.items() if value is not None]
    if what != "map" and given:
        raise click.UsageError(f"--{given[0].replace('_', '-')} belongs to --what map; leave it out for --what {what}")
    check_output(output, (".pdf", ".png", ".svg"), inputs=results)

    from octoreplay.report.figures import save_figure
    from octoreplay.report.result_figures import result_figure
    from octoreplay.result import open_result

    with ExitStack() as stack:
        opened = [stack.enter_context(open_result(path)) for path in results]
        save_figure(result_figure(what, _labelled(results, opened, labels), style, **of_map), output)
    terminal().line(f"wrote {output}")
    terminal().give(results=list(results), written=[output])
    return 0


def _labelled(paths: tuple[Path, ...], opened: list[Any], labels: tuple[str, ...]) -> dict[str, Any]:
    """Results by label; ConfigError for a wrong number of labels, or two equal ones."""
    if labels and len(labels) != len(paths):
        raise ConfigError(f"label: expects one for each of the {len(paths)} results, got {len(labels)}")
    names = list(labels) or [path.stem for path in paths]
    for index, name in enumerate(names):
        if name in names[:index]:
            raise ConfigError(f"{paths[index]}: two results have the label '{name}'; name each with --label")
    return dict(zip(names, opened, strict=True))
