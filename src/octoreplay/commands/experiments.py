"""Commands that repeat the experiments of the documentation: experiment NAME."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from octoreplay.commands.console import prints, terminal
from octoreplay.commands.options import existing_path, lock_folder
from octoreplay.commands.progress import progress_bar, replay_bar
from octoreplay.commands.suggestions import SuggestingGroup
from octoreplay.config.run import RunConfig

if TYPE_CHECKING:
    from octoreplay.simulate.settings import SimulationConfig


@click.group(cls=SuggestingGroup, short_help="Repeat the experiments of the documentation.")
def experiment() -> None:
    """Repeat an experiment: simulate, replay, and write its figures and numbers.

    Complete logs and results of the same settings in the folder are used again.
    """


@experiment.command(short_help="The paper's experiment: six robots explore a village for 300 s.")
@click.argument("folder", type=existing_path, metavar="[DIR]", default=Path("octoreplay-paper"), required=False)
@click.option("--duration", type=float, default=300.0, show_default=True, help="length of the logs, 6 s or more [s]")
@click.option("--robots", type=int, default=6, show_default=True, help="number of robots in the team")
@click.option("--seed", type=int, default=0, show_default=True, help="seed of the village and of all noise")
@prints
def paper(folder: Path, duration: float, robots: int, seed: int) -> int:
    """Repeat the paper's experiment and write its figures and numbers into DIR (default: octoreplay-paper).

    The figures show disagreement, packet sizes and maps. Takes about three minutes. Complete logs and results of the
    same settings in DIR are used again.
    """
    from octoreplay.io.output_file import mark_written
    from octoreplay.report.paper_table import paper_table
    from octoreplay.report.tables import made_files, number
    from octoreplay.study import paper as study

    lock_folder(folder)
    simulation = study.paper_team(robots, duration, seed)
    team_file = team_with_bar(folder / study.TEAM, simulation)
    result_with_bar(study.paper_config(team_file, simulation), folder / study.RESULT)
    here = terminal()
    here.note("drawing figures")
    numbers = study.write_paper(folder, simulation)
    mark_written(folder)
    here.show(paper_table([vars(moment) for moment in numbers.moments]))
    here.line(
        f"\u03a6 has its maximum {number(numbers.peak_total_distance)} at {numbers.peak_seconds:.0f} s; uniform grid /"
        f" octree is {numbers.mean_ratio:.2f} on average over time, {numbers.least_ratio:.2f} at least"
    )
    figures = folder / study.FIGURES
    made = {
        figures / "maps.png": "maps, with cells more transparent where robots deviate, and the village",
        figures / "total_distance.png": "\u03a6 over time",
        figures / "agreement.png": "agreement and label disagreement over time",
        figures / "packet_size.png": "size of a map as octree and as uniform grid, and their ratio",
        folder / study.NUMBERS: "all numbers, including those of this table",
        folder / study.RESULT: "result, for 'octoreplay metrics', 'export' and 'query'",
        folder / study.TEAM: "logs of the robots, team file and ground truth",
    }
    here.show(made_files(made))
    here.give(numbers=numbers, written=list(made))
    return 0


def _add_experiment(name: str, duration: float, num_villages: int, question: str, *, is_timed: bool = False) -> None:
    """Add the command of one experiment; ``is_timed`` if it measures time."""

    def run_and_report(
        folder: Path,
        duration: float,
        villages: int = 1,
        jobs: int | None = None,
        scheduler: str | None = None,
        teams: Path | None = None,
    ) -> int:
        from octoreplay.io.output_file import mark_written, write_whole
        from octoreplay.report.comparisons import latex, markdown
        from octoreplay.report.figures import save_figures
        from octoreplay.report.tables import made_files
        from octoreplay.study.experiments import run_experiment
        from octoreplay.study.questions import QUESTIONS

        lock_folder(folder)
        question = QUESTIONS[name]
        with progress_bar(name) as update:
            found = run_experiment(
                question.experiment(duration, villages), folder, teams_folder=teams, num_jobs=jobs, scheduler=scheduler,
                progress=lambda stage, share: update(share, None, stage),
            )  # fmt: skip
        tables = question.tables(found)
        write_whole(folder / "tables.md", "\n".join(map(markdown, tables)))
        write_whole(folder / "tables.tex", "\n".join(map(latex, tables)))
        drawn = {file: drawing.draw(found) for file, drawing in question.drawings.items()}
        written = {
            **dict.fromkeys(save_figures(drawn, folder / "figures"), "figure"),
            folder / "tables.md": "tables",
            folder / "tables.tex": "tables as LaTeX",
            **{folder / f"{plan}.csv": "numbers of every run" for plan in found},
        }
        mark_written(folder)
        terminal().show(made_files(written))
        terminal().give(written=list(written))
        return 0

    default = Path(f"octoreplay-{name}")
    # Parallel runs would disturb time measurements, and run times hardly depend on the village.
    sweep_options = (
        click.option("--villages", type=click.IntRange(1, 100), default=num_villages, show_default=True,
                     help="number of villages, each with a team of its own"),
        click.option("--jobs", type=click.IntRange(min=1), metavar="N",
                     help="number of parallel runs on this machine  [default: number of processors]"),
        click.option("--scheduler", metavar="tcp://HOST:PORT",
                     help="address of a dask scheduler; runs are executed on its workers instead of this machine"),
    )  # fmt: skip
    options = (
        click.argument("folder", type=existing_path, metavar="[DIR]", default=default, required=False),
        click.option("--duration", type=float, default=duration, show_default=True, help="length of the logs [s]"),
        click.option(
            "--teams",
            type=existing_path,
            metavar="DIR",
            help="folder of the simulated teams, which experiments can share  [default: DIR/teams]",
        ),
        *(() if is_timed else sweep_options),
    )
    text = (
        f"{question}\n\nSimulates teams, runs sweeps and writes tables and figures into DIR (default: {default}). The"
        " same command continues after an interruption."
    )
    command = prints(run_and_report)
    for option in reversed(options):
        command = option(command)
    experiment.command(name, help=text, short_help=question)(command)


_add_experiment("rules", 300.0, 10, "Compare the consensus rules.")
_add_experiment(
    "forgetting", 60.0, 10, "Measure what is kept by a robot that is cut off, and by a team that separates."
)
_add_experiment("packets", 60.0, 10, "Compare packet formats.")
_add_experiment("radio", 60.0, 10, "Measure what each fault of a radio costs.")
_add_experiment("noise", 60.0, 10, "Measure which wrong labels, poses and depths the exchange repairs and spreads.")
_add_experiment("confidence", 60.0, 10, "Measure how far the probabilities of sensor models and rules can be trusted.")
_add_experiment("steps", 60.0, 10, "Vary the step sizes epsilon and gamma.")
_add_experiment("scale", 20.0, 1, "Measure run times for numbers of robots, cells and classes.", is_timed=True)


def team_with_bar(folder: Path, simulation: SimulationConfig, *, replaces_others: bool = False) -> Path:
    """Simulate a team with a progress bar, or use it again, and report which; return the team file.

    With ``replaces_others`` a simulated team of other settings is replaced.
    """
    from octoreplay.study.teams import is_simulated, simulated_team

    exists = is_simulated(folder, simulation, replaces_others=replaces_others)
    with progress_bar("simulate") as update:
        team_file = simulated_team(
            folder, simulation, lambda share: update(share, None, ""), replaces_others=replaces_others
        )
    terminal().note(f"used the team in {folder} again" if exists else f"simulated the team in {folder}")
    return team_file


def result_with_bar(config: RunConfig, output: Path) -> Path:
    """Replay a team with a progress bar, or use its result again, and report which; return the result."""
    from octoreplay.study.teams import is_replayed, replayed_team

    exists = is_replayed(config, output)
    with replay_bar() as show:
        replayed_team(config, output, show)
    terminal().note(f"used {output} again" if exists else f"wrote {output}")
    return output
