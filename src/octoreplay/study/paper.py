"""The paper's experiment: six robots explore a village and iterate Alg. 1 on every arriving map.

::

    numbers = run_paper(Path("octoreplay-paper"), paper_team())
    print(numbers.mean_ratio)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from octoreplay._version import __version__
from octoreplay.config.presets import with_options
from octoreplay.config.run import RunConfig
from octoreplay.config.team_file import load_team_file
from octoreplay.errors import ConfigError, InputError
from octoreplay.io.output_file import write_whole
from octoreplay.io.text_files import json_text
from octoreplay.records import UInt8Array
from octoreplay.replay.run import Progress
from octoreplay.report import map_view, paper_plots
from octoreplay.report.figures import save_figures
from octoreplay.report.log_time import has_published, over_robots
from octoreplay.report.map_figure import AZIMUTH, ELEVATION
from octoreplay.result import Result, open_result
from octoreplay.run_metrics import TickMetrics
from octoreplay.simulate.settings import SimulationConfig
from octoreplay.simulate.village import make_village
from octoreplay.simulate.world import World
from octoreplay.stored_map import StoredMap
from octoreplay.study.teams import replayed_team, simulated_team

TEAM, RESULT, FIGURES, NUMBERS = "team", "paper.mcap", "figures", "numbers.json"
"""Files and folders in the experiment's folder."""

PRESET = "paper"
LEAST_DURATION = 6.0
"""Shortest duration [s] with which maps have been exchanged after a third of the run."""

_WIDTH, _HEIGHT = 1600, 1000
_PERCENTILE = 99.0


@dataclass(frozen=True)
class Moment:
    """Numbers of the team ``seconds`` after the run's start.

    ``total_distance`` is the paper's Phi. ``relative_distance`` is Phi per pair of robots divided by the mean squared
    norm of their maps. Bytes are means and standard deviations over the robots that published; ``ratio`` is mean grid
    bytes / mean octree bytes. Agreement is the minimum over the active robots. The deviation of an occupied cell is the
    largest ||h_i - h_j|| of two robots; ``median_deviation`` is over the ``num_occupied_cells`` cells that are occupied
    in any robot's map.
    """

    seconds: float
    total_distance: float
    relative_distance: float
    num_known_cells: int
    num_occupied_cells: int
    median_deviation: float
    label_disagreement: float
    agreement: float
    agreement_occupied: float
    octree_bytes: float
    octree_bytes_std: float
    grid_bytes: float
    grid_bytes_std: float
    unpruned_bytes: float
    packet_bytes: float
    ratio: float


@dataclass(frozen=True)
class PaperNumbers:
    """Numbers of the whole experiment.

    ``peak_total_distance`` is the largest Phi of any tick, reached ``peak_seconds`` after the run's start.
    ``mean_ratio`` is the mean over ticks of (size of a map as uniform grid) / (its size as octree), with both sizes
    averaged over robots; ``least_ratio`` is the minimum over ticks. ``transparent_deviation`` is the deviation at which
    a cell in the figure is fully transparent.
    """

    version: str
    simulation: SimulationConfig
    preset: str
    peak_total_distance: float
    peak_seconds: float
    mean_ratio: float
    least_ratio: float
    transparent_deviation: float
    moments: tuple[Moment, ...]


def paper_team(num_robots: int = 6, duration: float = 300.0, seed: int = 0) -> SimulationConfig:
    """Settings of the experiment's team. Raises ConfigError for a value out of range."""
    if duration < LEAST_DURATION:
        raise ConfigError(
            f"duration: {duration:g} s is too short for the experiment; use at least {LEAST_DURATION:g} s"
        )
    return SimulationConfig(num_robots=num_robots, duration=duration, seed=seed)


def paper_config(team_file: Path, simulation: SimulationConfig) -> RunConfig:
    """Run configuration of the team: preset 'paper', with maps stored after each third of the run (whole seconds)."""
    third = float(simulation.duration // 3)
    return with_options(load_team_file(team_file), PRESET, None, {"state_every": third, "view_every": third})


def run_paper(
    folder: Path,
    simulation: SimulationConfig,
    simulation_progress: Callable[[float], None] | None = None,
    replay_progress: Callable[[Progress], None] | None = None,
) -> PaperNumbers:
    """Repeat the experiment: write the team, its result, figures and numbers into a folder.

    A complete team and a complete result in the folder are used again. The callbacks receive the progress of the two
    long steps. Raises the errors of ``simulated_team``, ``replayed_team`` and ``write_paper``.
    """
    team_file = simulated_team(folder / TEAM, simulation, simulation_progress)
    replayed_team(paper_config(team_file, simulation), folder / RESULT, replay_progress)
    return write_paper(folder, simulation)


def write_paper(folder: Path, simulation: SimulationConfig) -> PaperNumbers:
    """Write the figures and numbers of the result in a folder.

    Raises OutputError if a file cannot be written, InputError for a damaged result or one without occupied cells.
    """
    with open_result(folder / RESULT) as result:
        ticks = _shown_ticks(result)
        seconds = [result.seconds(tick.stamp_ns) for tick in ticks]
        maps = [[result.map(robot_id, at_ns=tick.stamp_ns) for robot_id in result.robots] for tick in ticks]
        overlays = [map_view.overlay(together) for together in maps]
        largest = transparent_deviation(overlays)
        moments = tuple(map(_moment, seconds, ticks, overlays, map(relative_distance, ticks, maps)))
        numbers = _numbers(result, simulation, moments, largest)
        village = make_village(simulation.world_size, simulation.seed)
        pictures = _pictures(result, seconds, overlays, largest, village)
        figures = paper_plots.paper_figures(result.metrics, seconds)
        picture = paper_plots.maps_picture(pictures, result.class_table, largest)
    save_figures(figures, folder / FIGURES)
    write_whole(folder / FIGURES / "maps.png", picture)
    write_whole(folder / NUMBERS, json_text(numbers))
    return numbers


def transparent_deviation(overlays: Sequence[map_view.Overlay]) -> float:
    """Deviation at which the opacity is 0 in all overlays: the 99th percentile of the first overlay's deviations.

    Raises InputError if the first overlay has no cell.
    """
    if not len(overlays[0].labels):
        raise InputError("the robots' maps hold no occupied cell; use a longer duration")
    return float(np.percentile(overlays[0].deviations, _PERCENTILE))


def relative_distance(tick: TickMetrics, maps: Sequence[StoredMap]) -> float:
    """Phi over all pairs of robots, per pair, divided by the mean over maps of the sum over cells of ||h - h_0||^2."""
    spans = [stored.octree.spans() for stored in maps]
    norms = [float(span.num_cells @ np.square(span.deviations, dtype=np.float64).sum(axis=1)) for span in spans]
    num_pairs = len(maps) * (len(maps) - 1) / 2
    return tick.total_distance_all / num_pairs / float(np.mean(norms)) if num_pairs and any(norms) else 0.0


def _shown_ticks(result: Result) -> list[TickMetrics]:
    """Ticks of the two shown maps: after a third of the run, as the paper's 100 s of 300 s, and at its end."""
    stored = result.stored_ticks(result.robots[0])
    third = max(tick for tick in stored if 3 * tick <= stored[-1])
    return [tick for tick in result.metrics if tick.tick in (third, stored[-1])]


def _numbers(result: Result, simulation: SimulationConfig, moments: tuple[Moment, ...], largest: float) -> PaperNumbers:
    """Numbers of a result."""
    peak = max(result.metrics, key=lambda tick: tick.total_distance)
    octree, grid = (over_robots(result.metrics, name, has_published)[0] for name in ("octree_bytes", "grid_bytes"))
    ratios = (grid / octree)[np.isfinite(grid)]
    return PaperNumbers(
        __version__, simulation, PRESET, peak.total_distance, result.seconds(peak.stamp_ns), float(ratios.mean()),
        float(ratios.min()), largest, moments,
    )  # fmt: skip


def _moment(seconds: float, tick: TickMetrics, shown: map_view.Overlay, relative: float) -> Moment:
    """The numbers of one tick and of the maps shown at it."""
    names = ("octree_bytes", "grid_bytes", "unpruned_bytes", "packet_bytes")
    (octree, octree_std), (grid, grid_std), (unpruned, _), (packet, _) = (
        (float(mean[0]), float(std[0])) for mean, std in (over_robots([tick], name, has_published) for name in names)
    )
    active = [robot for robot in tick.robots if robot.active]
    return Moment(
        seconds, tick.total_distance, relative, tick.num_known_cells, len(shown.labels),
        float(np.median(shown.deviations)), tick.label_disagreement, min(robot.agreement for robot in active),
        min(robot.agreement_occupied for robot in active), octree, octree_std, grid, grid_std, unpruned, packet,
        grid / octree,
    )  # fmt: skip


def _pictures(
    result: Result, seconds: Sequence[float], overlays: Sequence[map_view.Overlay], largest: float, village: World
) -> dict[str, UInt8Array]:
    """Pictures by title, from one viewpoint: the last map, the earlier map and the true village."""
    colors = result.class_table.colors
    view = map_view.view_of(village.vertices, AZIMUTH, ELEVATION, _WIDTH, _HEIGHT)
    pictures = {}
    for at, shown in sorted(zip(seconds, overlays, strict=True), key=lambda pair: -pair[0]):
        solidity = map_view.opacities(shown.deviations, largest)
        cubes = map_view.cube_faces(shown.centers, shown.resolution, colors[shown.labels - 1], solidity)
        pictures[f"{at:.0f} s"] = map_view.draw(cubes, view)
    corners = village.vertices[village.triangles].astype(np.float64)
    pictures["The village"] = map_view.draw(map_view.mesh_faces(corners, colors[village.triangle_classes - 1]), view)
    return pictures
