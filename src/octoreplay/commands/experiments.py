"""Commands that repeat the experiments of the documentation: experiment NAME."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from octoreplay.commands.console import prints, terminal
from octoreplay.commands.options import check_no_file, existing_path, lock_folder
from octoreplay.commands.progress import progress_bar, replay_bar
from octoreplay.commands.suggestions import SuggestingGroup
from octoreplay.config.run import RunConfig

if TYPE_CHECKING:
    from octoreplay.simulate.settings import SimulationConfig
    from octoreplay.study.experiments import Experiment


@click.group(cls=SuggestingGroup, short_help="Repeat the experiments of the documentation.")
def experiment() -> None:
    """Repeat an experiment: make its teams, replay them, and write figures and numbers.

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


def _answer(name: str, teams: Experiment, folder: Path, *, teams_folder: Path | None, **run: Any) -> list[Path]:
    """Run the experiment of a question, and write its tables and figures; return the written files.

    ``teams_folder`` and ``run`` are options of run_experiment. Raises OutputError where ``teams_folder`` is a file.
    """
    from octoreplay.io.output_file import mark_written, write_whole
    from octoreplay.report.comparisons import latex, markdown
    from octoreplay.report.figures import save_figures
    from octoreplay.report.tables import made_files
    from octoreplay.study.experiments import run_experiment
    from octoreplay.study.questions import QUESTIONS

    if teams_folder is not None:
        check_no_file(teams_folder)
    question = QUESTIONS[name]
    with progress_bar(name) as update:
        found = run_experiment(
            teams,
            folder,
            teams_folder=teams_folder,
            **run,
            progress=lambda stage, share: update(share, None, stage),
        )
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
    return list(written)


_parallel_options = (
    click.option("--jobs", type=click.IntRange(min=1), metavar="N",
                 help="number of parallel runs on this machine  [default: number of processors]"),
    click.option("--scheduler", metavar="tcp://HOST:PORT",
                 help="address of a dask scheduler; runs are executed on its workers instead of this machine"),
)  # fmt: skip


def _folder_argument(name: str) -> Callable[[Any], Any]:
    """The argument DIR of an experiment."""
    default = Path(f"octoreplay-{name}")
    return click.argument("folder", type=existing_path, metavar="[DIR]", default=default, required=False)


def _add_command(
    name: str, question: str, text: str, run_and_report: Callable[..., int], options: Sequence[Callable[[Any], Any]]
) -> None:
    """Add a command with its help text and its options in their order."""
    command = prints(run_and_report)
    for option in reversed(options):
        command = option(command)
    experiment.command(name, help=text, short_help=question)(command)


_SIMULATED: dict[str, tuple[float, int]] = {}
"""Length of the logs [s] and number of villages of the experiments with simulated teams, by name."""
_RECORDED: list[str] = []
"""Names of the experiments with recorded teams."""


def _add_experiment(name: str, duration: float, num_villages: int, question: str, *, is_timed: bool = False) -> None:
    """Add the command of one experiment with simulated teams; ``is_timed`` if it measures time."""
    _SIMULATED[name] = (duration, num_villages)

    def run_and_report(
        folder: Path,
        duration: float,
        villages: int = 1,
        jobs: int | None = None,
        scheduler: str | None = None,
        teams: Path | None = None,
    ) -> int:
        from octoreplay.study.questions import QUESTIONS

        lock_folder(folder)
        simulated = QUESTIONS[name].experiment(duration, villages)
        terminal().give(
            written=_answer(name, simulated, folder, teams_folder=teams, num_jobs=jobs, scheduler=scheduler)
        )
        return 0

    # Parallel runs would disturb time measurements, and run times hardly depend on the village.
    sweep_options = (
        click.option("--villages", type=click.IntRange(1, 100), default=num_villages, show_default=True,
                     help="number of villages, each with a team of its own"),
        *_parallel_options,
    )  # fmt: skip
    options = (
        _folder_argument(name),
        click.option("--duration", type=float, default=duration, show_default=True, help="length of the logs [s]"),
        click.option("--teams", type=existing_path, metavar="DIR",
                     help="folder of the simulated teams, which experiments can share  [default: DIR/teams]"),
        *(() if is_timed else sweep_options),
    )  # fmt: skip
    text = (
        f"{question}\n\nSimulates teams, runs sweeps and writes tables and figures into DIR (default:"
        f" octoreplay-{name}). The same command continues after an interruption."
    )
    _add_command(name, question, text, run_and_report, options)


_add_experiment("rules", 300.0, 10, "Compare the consensus rules.")
_add_experiment("graphs", 30.0, 10, "Measure what the hops of a graph cost.")
_add_experiment(
    "forgetting", 30.0, 10, "Measure what is kept by a robot that is cut off, and by a team that separates."
)
_add_experiment("packets", 30.0, 10, "Compare packet formats.")
_add_experiment("radio", 30.0, 10, "Measure what each fault of a radio costs.")
_add_experiment("delay", 30.0, 10, "Measure what a delay costs with ticks of two lengths.")
_add_experiment("noise", 30.0, 10, "Measure which wrong labels, poses and depths the exchange repairs and spreads.")
_add_experiment("confidence", 60.0, 10, "Measure how far the probabilities of sensor models and rules can be trusted.")
_add_experiment("steps", 30.0, 10, "Vary the step sizes epsilon and gamma, and the reading of the evidence.")
_add_experiment("scale", 20.0, 1, "Measure run times for numbers of robots, cells and classes.", is_timed=True)
_add_experiment("frames", 40.0, 10, "Measure which frames 'align' finds, and which wrong ones it accepts.")
_add_experiment("drift", 40.0, 10, "Measure what wrong poses cost, and what 'refine' repairs.")
_add_experiment("misalignment", 40.0, 10, "Measure from which errors of the frames on an exchange of maps does harm.")


def _add_recorded(name: str, question: str, runs: str) -> None:
    """Add the command of one experiment with recorded teams; ``runs`` says what is done with each team."""
    _RECORDED.append(name)

    def run_and_report(
        folder: Path, data: tuple[Path, ...], teams: Path | None, jobs: int | None, scheduler: str | None
    ) -> int:
        from octoreplay.study.questions import QUESTIONS

        lock_folder(folder)
        recorded = QUESTIONS[name].experiment(data)
        terminal().give(written=_answer(name, recorded, folder, teams_folder=teams, num_jobs=jobs, scheduler=scheduler))
        return 0

    options = (
        _folder_argument(name),
        click.option("--data", type=existing_path, multiple=True, required=True, metavar="FOLDER|TEAM.yaml",
                     help="recording: a folder of depth images with poses that import-rgbd reads, or a folder of such"
                          " folders; or a team file with right frames; may be repeated"),
        click.option("--teams", type=existing_path, metavar="DIR",
                     help="folder of the teams' logs, which experiments can share  [default: DIR/teams]"),
        *_parallel_options,
    )  # fmt: skip
    text = (
        f"{question}\n\nA recording is split into teams of 2, 3 and 4 robots; the recordings of a folder of folders are"
        f" one team, and so is a team file. {runs} Writes tables and figures into DIR (default: octoreplay-{name}). The"
        " same command continues after an interruption."
    )
    _add_command(name, question, text, run_and_report, options)


_add_recorded(
    "real",
    "Measure what agrees on real recordings, before and after 'align'.",
    "Each team is replayed with right frames, with random ones of each robot, and with those that 'align' finds.",
)
_add_recorded(
    "prediction",
    "Measure how well maps of each sensor model predict what another robot measures.",
    "Each team is replayed with right frames and every sensor model.",
)


@experiment.command("all", short_help="Repeat all experiments but 'paper', in one night.")
@_folder_argument("all")
@click.option(
    "--data",
    type=existing_path,
    multiple=True,
    metavar="FOLDER|TEAM.yaml",
    help="recording or team, as of 'real' and 'prediction', which are left out without one; may be repeated",
)
@_parallel_options[0]
@prints
def everything(folder: Path, data: tuple[Path, ...], jobs: int | None) -> int:
    """Repeat all experiments but 'paper', with their default settings, one after the other.

    Each gets a folder in DIR (default: octoreplay-all); they share the simulated teams in DIR/teams. The same command
    continues after an interruption.
    """
    from octoreplay.study.questions import QUESTIONS

    lock_folder(folder)
    inputs = {**_SIMULATED, **{name: (data,) for name in _RECORDED if data}}
    # A recording that cannot be used is refused before the first run.
    experiments = {name: QUESTIONS[name].experiment(*values) for name, values in inputs.items()}
    written: list[Path] = []
    for name, teams in experiments.items():
        written += _answer(name, teams, folder / name, teams_folder=folder / "teams", num_jobs=jobs)
    terminal().give(written=written)
    return 0


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
