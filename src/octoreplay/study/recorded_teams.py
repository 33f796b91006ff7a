"""Teams made of recordings of depth images, whose frames are right, unrelated or found by an alignment."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from octoreplay._version import __version__
from octoreplay.config.robot import RobotConfig
from octoreplay.config.run import RunConfig
from octoreplay.config.team_file import load_team_file
from octoreplay.errors import InputError
from octoreplay.io.datasets.rgbd_folder import import_rgbd
from octoreplay.io.datasets.rgbd_layouts import find_layout, find_sequences
from octoreplay.io.output_file import new_folder, writing
from octoreplay.io.text_files import json_text
from octoreplay.study.team_frames import RIGHT, own_frame, team_file, without_frames, write_team_files
from octoreplay.transforms import inverse, numbers_of

RATE = 1.0
"""Images per second of every log [Hz]: a robot maps one image between two published maps."""
RESOLUTION, MAX_RANGE = 0.1, 4.0
"""Edge of a cell, and the range of a depth camera that is mapped [m]."""
ALIGNED_RESOLUTION = 0.05
"""Edge of a cell of the maps that are aligned [m]; those of a room need finer cells than a run."""
_NUM_IMAGES = 50
"""Number of images that a whole recording is thinned to, unless the parts of a split need more."""
_TEAM_SIZES = (2, 3, 4)
_OVERLAPS = (0.0, 0.25, 0.5)
_LEAST_IMAGES = 64
"""Least number of images of a recording that is split: four for each robot of the largest team."""


@dataclass(frozen=True)
class Part:
    """Images of one robot: every ``every``-th one of ``folder``, from ``first`` to ``last`` (included)."""

    folder: Path
    first: int
    last: int
    every: int


@dataclass(frozen=True)
class RecordedTeam:
    """Team of parts of recordings.

    Attributes
    ----------
    parts : tuple of Part
        Images of each robot.
    frames : str
        One of ``FRAMES``.
    seed : int
        Seed of the robots' own frames. Teams of one seed have the same logs and differ in ``frames`` only.
    """

    parts: tuple[Part, ...]
    frames: str
    seed: int

    @property
    def folder_name(self) -> str:
        """Name of the folder of the logs, which changes with the images' paths, sizes and times of change."""
        images = [_files(part) for part in self.parts]
        digest = hashlib.sha256(json_text([__version__, self.seed, self.parts, images]).encode()).hexdigest()[:10]
        return f"recording_{self.seed}_{digest}"

    def write(self, folder: Path, progress: Callable[[float], None]) -> None:
        """Write the logs, and a team file for each kind of frames, unless the folder exists.

        Raises the errors of ``import_rgbd`` and ``align_logs``.
        """
        if folder.exists():
            return
        with writing(folder):
            folder.parent.mkdir(parents=True, exist_ok=True)
        with new_folder(folder) as new:
            config = RunConfig(tuple(self._robots(new.path))).with_parameters(
                {"resolution": RESOLUTION, "max_range": MAX_RANGE}
            )
            write_team_files(new.path, config, without_frames(config), 6, ALIGNED_RESOLUTION, progress)
            new.put()

    def team_file(self, label: str, folder: Path) -> Path | None:
        """Return the team file with the team's frames; None where ``align`` connected no two robots."""
        del label
        return team_file(folder, self.frames)

    def right_config(self, run: RunConfig) -> RunConfig:
        """Return the configuration with right frames of the team of a run, beside its logs."""
        return load_team_file(Path(run.robots[0].logs[0].parent) / f"{RIGHT}.yaml")

    @property
    def num_robots(self) -> int:
        """Number of robots."""
        return len(self.parts)

    def _robots(self, folder: Path) -> Iterator[RobotConfig]:
        """Write the log of each robot in a frame of its own, and yield the robots with the right frames."""
        rng = np.random.default_rng(self.seed)
        for number, part in enumerate(self.parts, start=1):
            T_map_given, log = own_frame(rng), folder / f"robot_{number}.mcap"
            import_rgbd(
                part.folder, log, rate=RATE, first=part.first, last=part.last, every=part.every,
                map_frame=f"{log.stem}/odom", T_map_given=T_map_given,
            )  # fmt: skip
            yield RobotConfig(log.stem, (log,), T_team_map=numbers_of(inverse(T_map_given)))


def recorded_parts(recordings: Sequence[Path]) -> Iterator[tuple[Part, ...]]:
    """Yield the parts of each team that recordings give.

    A folder of several sequences is one team: a robot for each sequence. A single sequence gives a team for each number
    of robots, 2 to 4, and each share of images, 0, 0.25 and 0.5, that a part has in common with the next one in time.
    No image belongs to two robots.

    Raises InputError for a folder without sequences, and for a single sequence of less than 64 images.
    """
    for recording in recordings:
        sequences = find_sequences(recording) or [recording]
        if len(sequences) > 1:
            yield tuple(_whole(sequence) for sequence in sequences)
            continue
        (sequence,) = sequences
        num_images = len(find_layout(sequence).frames)
        if num_images < _LEAST_IMAGES:
            raise InputError(
                f"{sequence}: has {num_images} depth images, fewer than the {_LEAST_IMAGES} that are split into robots;"
                " name a longer sequence, or a folder of several sequences"
            )
        for num_robots in _TEAM_SIZES:
            for overlap in _OVERLAPS:
                yield tuple(_split(sequence, num_images, num_robots, overlap))


def _whole(sequence: Path) -> Part:
    """A whole sequence."""
    num_images = len(find_layout(sequence).frames)
    return Part(sequence.resolve(), 0, num_images - 1, max(1, num_images // _NUM_IMAGES))


def _split(sequence: Path, num_images: int, num_robots: int, overlap: float) -> Iterator[Part]:
    """Parts of equal length; each begins before the end of the former one by a share ``overlap`` of the length."""
    every = max(max(_TEAM_SIZES), num_images // _NUM_IMAGES)
    length = num_images / (num_robots - (num_robots - 1) * overlap)
    for index in range(num_robots):
        start = round(index * (1.0 - overlap) * length)
        # The remainder of an image's number says which robot may have it.
        first = start + (index - start) % every
        end = min(round(start + length), num_images)
        yield Part(sequence.resolve(), first, max(first, end - 1), every)


def _files(part: Part) -> list[tuple[str, int, int]]:
    """Names, sizes and times of change of a part's depth images."""
    frames = find_layout(part.folder).frames[part.first : part.last + 1 : part.every]
    stats = [(frame.depth_file, frame.depth_file.stat()) for frame in frames]
    return [(path.name, stat.st_size, stat.st_mtime_ns) for path, stat in stats]
