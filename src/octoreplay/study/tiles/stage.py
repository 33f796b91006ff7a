"""Progress of the tiles of a run, and the values with which all of them settle."""

from __future__ import annotations

import json
from collections.abc import Collection
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple, Self

from octoreplay.config.resolved import ResolvedRun
from octoreplay.io.output_file import write_whole
from octoreplay.replay.settling import num_finer_ticks
from octoreplay.study.tiles.geometry import Tile
from octoreplay.study.tiles.work_folder import AGREEMENT


@dataclass(frozen=True)
class Stage:
    """Progress of a tile.

    Attributes
    ----------
    num_ticks, num_settling : int
        Ticks, and those of them in which the tile settled.
    lengths : (int, int)
        Lengths of the files of ticks and of maps [byte].
    largest : float
        Largest |log-odds| of any map at the end of the logs.
    num_finer : int or None
        Settling ticks in which flows get finer; None before settling.
    stop_reason : str
        Reason for the end; empty before settling.
    is_symmetric : bool
        True where all links carried both ways with the same weight.
    num_frames_off : list of dict
        Frames that were left out because the schedule had the robot off, by robot and sensor.
    """

    num_ticks: int
    num_settling: int
    lengths: tuple[int, int]
    largest: float
    num_finer: int | None
    stop_reason: str
    is_symmetric: bool
    num_frames_off: list[dict[int, int]]

    def save(self, path: Path) -> None:
        """Write a file for ``load_stage``. Raises OutputError."""
        write_whole(path, json.dumps(asdict(self)))

    def is_complete(self, config: ResolvedRun, agreement: Agreement) -> bool:
        """Return True where the tile has settled as the others have."""
        return self.num_finer == agreement.num_finer(config) and self.num_settling >= agreement.least_ticks


def load_stage(path: Path) -> Stage | None:
    """Return a stored stage; None without one."""
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        values["num_frames_off"] = [{int(k): n for k, n in off.items()} for off in values["num_frames_off"]]
        values["lengths"] = tuple(values["lengths"])
        return Stage(**values)
    except (OSError, ValueError, TypeError, KeyError):
        return None


class Agreement(NamedTuple):
    """Values with which all tiles of a run settle, as far as finished tiles give them.

    A team has settled where all its tiles have, so every tile goes on until the last one has settled.

    - ``largest``: largest |log-odds| of any tile's map at the end of the logs.
    - ``least_ticks``: largest number of settling ticks of the tiles that settled with the ``num_finer`` of ``largest``.
    """

    largest: float
    least_ticks: int

    @classmethod
    def of(cls, config: ResolvedRun, stages: Collection[Stage]) -> Self:
        """Return the agreement of some tiles, at least one."""
        agreement = cls(max(stage.largest for stage in stages), 0)
        num_finer = agreement.num_finer(config)
        return agreement._replace(
            least_ticks=max((stage.num_settling for stage in stages if stage.num_finer == num_finer), default=0)
        )

    def num_finer(self, config: ResolvedRun) -> int:
        """Return the number of settling ticks in which flows get finer; 0 in a run that does not settle."""
        return num_finer_ticks(config, self.largest) if config.consensus.settle else 0

    def with_tile(self, config: ResolvedRun, largest: float) -> Self:
        """Return the agreement with one more tile, which has not settled."""
        if largest <= self.largest:
            return self
        joined = self._replace(largest=largest)
        is_same = joined.num_finer(config) == self.num_finer(config)
        return joined if is_same else joined._replace(least_ticks=0)

    def save(self, folder: Path) -> None:
        """Write the agreement into a work folder. Raises OutputError."""
        write_whole(folder / AGREEMENT, json.dumps(self))

    @classmethod
    def load(cls, folder: Path) -> Self | None:
        """Return the agreement in a work folder; None without one."""
        try:
            largest, least_ticks = json.loads((folder / AGREEMENT).read_text(encoding="utf-8"))
            return cls(float(largest), int(least_ticks))
        except (OSError, ValueError, TypeError):
            return None


class TileFiles:
    """Paths of the work files of a tile in a folder."""

    def __init__(self, folder: Path, tile: Tile) -> None:
        self.ticks = folder / f"{tile.name}.ticks"
        self.maps = folder / f"{tile.name}.maps"
        self.last_maps = folder / f"{tile.name}.last"
        self.state = folder / f"{tile.name}.state"
        self.stage = folder / f"{tile.name}.json"

    def read_stage(self) -> Stage | None:
        """Return the progress of the tile; None where it has not finished its logs."""
        stage = load_stage(self.stage)
        if stage is None:
            return None
        try:
            sizes = self.ticks.stat().st_size, self.maps.stat().st_size
        except OSError:
            return None
        is_whole = self.state.exists() and all(size >= n for size, n in zip(sizes, stage.lengths, strict=True))
        return stage if is_whole else None
