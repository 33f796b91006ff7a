"""A public data set by name, and the team that is made of its files."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType

from octoreplay.config.robot import RobotConfig
from octoreplay.records import ClassTable

ODOMETRY_FIRST = "poses: {reason}; compute them, for example with 'octoreplay odometry', and store them as {file}"
"""Sentence for a robot whose data set has no usable poses."""


@dataclass(frozen=True)
class Team:
    """Robots of a data set, with the settings of the team file.

    ``missing`` are sentences on what a run lacks, by robot_id. ``num_skipped`` frames of imported folders were left out
    because they have no usable pose.
    """

    robots: tuple[RobotConfig, ...]
    classes: ClassTable | None = None
    missing: Mapping[str, tuple[str, ...]] = field(default_factory=lambda: MappingProxyType({}))
    num_skipped: int = 0


@dataclass(frozen=True)
class Work:
    """Folders of a preparation: logs are written into ``new``, which becomes ``output`` at the end.

    ``every`` selects each n-th frame of folders. ``progress`` is called with the finished share, 0 to 1.
    """

    folder: Path
    new: Path
    output: Path
    every: int = 1
    progress: Callable[[float], None] | None = None


@dataclass(frozen=True)
class DataSet(ABC):
    """A data set.

    ``holds`` describes its files, ``checked`` what this description was compared with, ``sources`` are the documents.
    ``notes`` are sentences for the team file. ``parameters`` are settings of the run.
    """

    name: str
    title: str
    holds: str
    checked: str
    sources: tuple[str, ...]
    notes: tuple[str, ...] = ()
    parameters: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))

    @abstractmethod
    def team(self, work: Work) -> Team:
        """Return the team of a folder. Raises InputError where the folder does not hold the data set."""
