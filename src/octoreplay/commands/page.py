"""Commands that show a result: report, view."""

from __future__ import annotations

import contextlib
import time
import webbrowser
from pathlib import Path

import click

from octoreplay.commands.console import prints, terminal
from octoreplay.commands.options import check_output, existing_path, force_option, max_depth_option, parse_size


@click.command(short_help="Write a result as a web page: 3-D map over time, charts, tables.")
@click.argument("result", type=existing_path, metavar="RESULT.mcap")
@click.option("-o", "--output", type=existing_path, required=True, metavar="PAGE.html", help="page to write")
@click.option("--max-size", callback=parse_size, default="25MB", show_default=True, metavar="SIZE",
              help="size of the page; fine cells are left out where it would be larger")  # fmt: skip
@max_depth_option
@force_option
@prints
def report(result: Path, output: Path, max_size: int, max_depth: int | None) -> int:
    """Write a result as one HTML file that a browser opens without a network.

    It shows the maps in 3-D over log time, the metrics as charts, and tables of settings, inputs and warnings.
    """
    check_output(output, ".html", [result])

    from octoreplay.report.page.page import write_page
    from octoreplay.report.tables import size

    num_bytes = write_page(result, output, max_bytes=max_size, max_depth=max_depth)
    terminal().line(f"wrote {output} ({size(num_bytes)}); open it in a browser")
    if num_bytes > max_size:
        terminal().warn(f"{output} is larger than --max-size: its coarsest cells, charts and tables need this size")
    terminal().give(result=result, written=[output], num_bytes=num_bytes)
    return 0


@click.command(short_help="Show a result in a browser or a window.")
@click.argument("result", type=existing_path, metavar="RESULT.mcap")
@click.option("--port", type=click.IntRange(0, 65535), default=0, show_default=True,
              help="port of the server on this machine, 0 for a free one")  # fmt: skip
@click.option("--no-browser", is_flag=True, help="print the address and open no browser")
@click.option("--window", is_flag=True, help="show the last map of the first robot in a window of Open3D")
@max_depth_option
@prints
def view(result: Path, port: int, no_browser: bool, window: bool, max_depth: int | None) -> int:
    """Show a result in a browser: the page of 'octoreplay report' with all cells, however large the maps are.

    The page is served to this machine only, until Ctrl-C.
    """
    from octoreplay.result import open_result

    with open_result(result) as opened:
        if window:
            from octoreplay.report.window import show_window

            show_window(opened, max_depth)
            return 0
        from octoreplay.report.page.server import served

        terminal().give(result=result)
        with contextlib.suppress(KeyboardInterrupt), served(opened, port, max_depth) as url:
            terminal().line(f"{result} is shown at {url} until Ctrl-C")
            if not no_browser:
                webbrowser.open(url)
            while True:
                time.sleep(3600)
    return 0
