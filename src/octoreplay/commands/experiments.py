"""Experiments that one command repeats: octoreplay experiment NAME."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import click

from octoreplay.commands.options import existing_path
from octoreplay.commands.progress import progress_bar, replay_bar
from octoreplay.config.run import RunConfig

if TYPE_CHECKING:
    from octoreplay.simulate.team import SimulationConfig


@click.group(short_help="Repeat the experiments of the documentation.")
def experiment() -> None:
    """Repeat an experiment: simulate, replay, and write its figures and numbers.

    What a folder holds already is used again where it is complete and of the same settings.
    """


@experiment.command(short_help="The paper's experiment: six robots explore a village for 300 s.")
@click.argument("folder", type=existing_path, metavar="[DIR]", default=Path("octoreplay-paper"), required=False)
@click.option("--duration", type=float, default=300.0, show_default=True, help="length of the logs, 6 s or more [s]")
@click.option("--robots", type=int, default=6, show_default=True, help="robots in the team")
@click.option("--seed", type=int, default=0, show_default=True, help="another seed, another village")
def paper(folder: Path, duration: float, robots: int, seed: int) -> int:
    """Do the paper's experiment into DIR (octoreplay-paper): figures of disagreement, packets and maps, and numbers.

    Takes about three minutes. What DIR holds already is used again where it is complete and of the same settings.
    """
    from octoreplay.report import tables
    from octoreplay.report.experiment_tables import paper_table
    from octoreplay.study import paper as study

    simulation = study.paper_team(robots, duration, seed)
    team_file = team_with_bar(folder / study.TEAM, simulation)
    result_with_bar(study.paper_config(team_file, simulation), folder / study.RESULT)
    click.echo("drawing", err=True)
    numbers = study.write_paper(folder, simulation)
    out = tables.terminal()
    tables.show(out, paper_table([vars(moment) for moment in numbers.moments]))
    peak = tables.number(numbers.peak_total_distance)
    out.print(
        f"\u03a6 is largest at {numbers.peak_seconds:.0f} s, {peak}; uniform grid / octree is {numbers.mean_ratio:.2f}"
        f" in the mean over time, {numbers.least_ratio:.2f} at least\n",
        soft_wrap=True,
    )
    figures = folder / study.FIGURES
    made = {
        figures / "maps.png": "the maps, cells as transparent as robots deviate, and the village",
        figures / "total_distance.png": "\u03a6 over time",
        figures / "agreement.png": "agreement and different labels over time",
        figures / "packet_size.png": "bytes of a map as octree and as uniform grid, and the ratio",
        folder / study.NUMBERS: "the numbers of this table and more",
        folder / study.RESULT: "the result, for 'octoreplay metrics', 'export' and 'query'",
        folder / study.TEAM: "what the robots recorded, and the village they drove through",
    }
    tables.show(out, tables.made_files(made))
    return 0


def _add_question(name: str, duration: float, num_villages: int, question: str, *, is_timed: bool = False) -> None:
    """Add the command of one of the questions."""

    def answer(
        folder: Path,
        duration: float,
        villages: int = 1,
        jobs: int | None = None,
        scheduler: str | None = None,
    ) -> int:
        from octoreplay.io.text_files import write_whole
        from octoreplay.report import tables
        from octoreplay.report.experiment_plots import figures
        from octoreplay.report.experiment_tables import answer_tables
        from octoreplay.report.figures import save_figures
        from octoreplay.study.experiments import run_experiment
        from octoreplay.study.questions import QUESTIONS

        with progress_bar(name) as update:
            found = run_experiment(
                QUESTIONS[name](duration, villages), folder, num_jobs=jobs, scheduler=scheduler,
                progress=lambda stage, share: update(share, None, stage),
            )  # fmt: skip
        summary = folder / "tables.md"
        write_whole(summary, answer_tables(name, found))
        written = {
            **dict.fromkeys(save_figures(figures(name, found), folder / "figures"), "figure"),
            summary: "the answer as tables",
            **{folder / f"{plan}.csv": "every run" for plan in found},
        }
        tables.show(tables.terminal(), tables.made_files(written))
        return 0

    default = Path(f"octoreplay-{name}")
    # These make no sense where time is measured.
    of_sweeps = (
        click.option("--villages", type=click.IntRange(1, 100), default=num_villages, show_default=True,
                     help="so many villages, each with a team of its own"),
        click.option("--jobs", type=click.IntRange(min=1), metavar="N", help="runs at once  [default: processors]"),
        click.option("--scheduler", metavar="tcp://HOST:PORT", help="run on this dask cluster, not on this machine"),
    )  # fmt: skip
    options = (
        click.argument("folder", type=existing_path, metavar="[DIR]", default=default, required=False),
        click.option("--duration", type=float, default=duration, show_default=True, help="length of the logs [s]"),
        *(() if is_timed else of_sweeps),
    )
    text = (
        f"{question}\n\nSimulates teams, runs sweeps and writes tables and figures into DIR ({default}). The same"
        " command goes on where it was stopped."
    )
    command: Callable[..., int] = answer
    for option in reversed(options):
        command = option(command)
    experiment.command(name, help=text, short_help=question)(command)


_add_question("rules", 60.0, 3, "Which rule, on which graph?")
_add_question("steps", 60.0, 1, "How do epsilon and gamma trade consensus against the robots' own evidence?")
_add_question("scale", 20.0, 1, "How many robots, cells and classes are mapped in real time?", is_timed=True)
_add_question("noise", 60.0, 1, "What does consensus repair of noisy labels, poses and depths, what does it spread?")
_add_question("choose", 60.0, 2, "Which settings for a good radio, for a poor one, and for many robots?")


def team_with_bar(folder: Path, simulation: SimulationConfig) -> Path:
    """A simulated team with a progress bar, and a sentence that says whether it was there; the team file."""
    from octoreplay.study.teams import is_simulated, simulated_team

    is_there = is_simulated(folder, simulation)
    with progress_bar("simulate") as update:
        team_file = simulated_team(folder, simulation, lambda share: update(share, None, ""))
    click.echo(f"used the team in {folder} again" if is_there else f"simulated the team in {folder}", err=True)
    return team_file


def result_with_bar(config: RunConfig, output: Path) -> Path:
    """A team's result with a progress bar, and a sentence that says whether it was there; the result."""
    from octoreplay.study.teams import is_replayed, replayed_team

    is_there = is_replayed(config, output)
    with replay_bar() as show:
        replayed_team(config, output, show)
    click.echo(f"used {output} again" if is_there else f"wrote {output}", err=True)
    return output
