"""First pass over the logs of a run in tiles: the rays of every scan are cast once."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

from octoreplay.config.file_url import InputFile
from octoreplay.config.resolved import ResolvedRun
from octoreplay.errors import InputError
from octoreplay.io.containers.fingerprint import Fingerprint, fingerprint, log_files
from octoreplay.io.robots.read_ahead import ReadAhead
from octoreplay.io.robots.sensor_logs import SensorLogs
from octoreplay.io.robots.team_bodies import TeamBodies
from octoreplay.mapping.sensor import ScanCaster, sensor_reach
from octoreplay.replay.timeline import Timeline
from octoreplay.study.tiles.scans import ScanFiles, ScanWriter
from octoreplay.study.tiles.worker import Setup


def team_start_ns(config: ResolvedRun) -> int:
    """Return the first stamp of any robot. Raises InputError for logs that cannot be used."""
    with ExitStack() as stack:
        return min(stack.enter_context(_open(config, index)).first_stamp_ns for index in range(len(config.robots)))


def cast_groups(config: ResolvedRun, folder: Path, num_threads: int) -> list[tuple[int, ...]]:
    """Return groups of the robots whose scans an earlier run has not cast; each group is one request to a worker.

    Bodies of robots that hide points are read from the logs of the whole team, so that all robots are in one group.
    """
    left = [index for index in range(len(config.robots)) if not ScanFiles(folder, index).index.exists()]
    size = len(left) if config.sensor.hide_robots else num_threads
    return [tuple(left[first : first + size]) for first in range(0, len(left), max(size, 1))]


def cast_scans(
    setup: Setup,
    robots: Sequence[int],
    start_ns: int,
    block_cells: int,
    num_axes: int,
    inputs: Mapping[str, Fingerprint],
) -> int:
    """Cast the rays of all scans of some robots and write the touched cells, as a request to a worker.

    ``start_ns`` is the first stamp of the team; ``block_cells`` and ``num_axes`` are those of ``ScanWriter``;
    ``inputs`` are the fingerprints of the logs at the beginning of the run, by path or URL. Returns the number of
    robots. Raises ConfigError, InputError and OutputError.
    """
    config = setup.config
    _check_unchanged([file for index in robots for file in config.robots[index].files], inputs)
    with ExitStack() as stack:
        logs = [stack.enter_context(_open(config, index)) for index in robots]
        sources = [stack.enter_context(ReadAhead(log, start_ns)) for log in logs]
        hides = config.sensor.hide_robots
        bodies = stack.enter_context(TeamBodies(config.robots, config.time)) if hides else None
        writers = [
            stack.enter_context(ScanWriter(ScanFiles(setup.folder, index), block_cells, num_axes)) for index in robots
        ]
        casters = [ScanCaster(config.effective_sensor, config.map, config.classes.num_classes) for _ in robots]
        threads = stack.enter_context(ThreadPoolExecutor(setup.num_threads))
        timeline = Timeline(sources)

        def cast(place: int, until_ns: int) -> None:
            for frame in timeline.frames_before(place, until_ns):
                seen = frame if bodies is None else bodies.add_to(robots[place], frame)
                writers[place].write(seen, casters[place].cast(seen))

        period_ns = round(config.network.publish_period * 1e9)
        while (next_ns := timeline.next_stamp_ns) is not None:
            until_ns = next_ns + period_ns
            if bodies is not None:
                bodies.advance(next_ns, until_ns)
            list(threads.map(cast, range(len(robots)), [until_ns] * len(robots)))
        for log, writer in zip(logs, writers, strict=True):
            writer.finish(log.sensor_counts)
    return len(robots)


def _check_unchanged(paths: Iterable[InputFile], inputs: Mapping[str, Fingerprint]) -> None:
    """Raise InputError where this process finds another version of a log than the run began with."""
    for file in (file for path in paths for file in log_files(path)):
        began = inputs.get(str(file.resolve()))
        if began is None:
            continue
        now = fingerprint(file, whole=began.method == "sha256")
        if (now.size, now.value) != (began.size, began.value):
            raise InputError(
                f"{file}: a worker found another version of it than the run began with; run with --restart to start"
                " from the beginning"
            )


def _open(config: ResolvedRun, index: int) -> SensorLogs:
    """Open a robot's log."""
    return SensorLogs(config.robots[index], config.time, config.classes, reach=sensor_reach(config.sensor, config.map))
