"""Data sets that are folders of images or clouds: each sequence becomes the log of a robot."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from octoreplay.config.class_file import with_classes
from octoreplay.config.robot import RobotConfig
from octoreplay.config.run import RunConfig
from octoreplay.errors import InputError
from octoreplay.io.datasets.catalogue.data_set import DataSet, Team, Work
from octoreplay.io.datasets.frames_folder import check_folder, robot_name
from octoreplay.records import ClassTable

_LEVELS = ("", "*/", "*/*/", "*/*/*/")
"""Places of sequences below the given folder."""


class Imported(Protocol):
    """Summary of an import."""

    @property
    def num_without_pose(self) -> int:
        """Number of frames left out because they have no usable pose."""


@dataclass(frozen=True, kw_only=True)
class Folders(DataSet):
    """A data set of folders.

    - A sequence is a folder with ``marker``, a pattern of names in it, here or up to three folders below.
    - ``write_log`` writes the log of a sequence from its folder, with the keywords of the importers: ``robot_id``,
      ``map_frame``, ``class_table``, ``every``, ``progress``.
    - ``map_frame`` is the frame of the poses: 'map' where the sequences share one.
    - ``classes`` gives the class table of a sequence's labels, by name or as a table; None without labels.
    """

    marker: str
    write_log: Callable[..., Imported]
    map_frame: str = "odom"
    classes: Callable[[Path], str | ClassTable | None] = lambda _: None

    def team(self, work: Work) -> Team:
        """Return the team, and write its logs. Raises InputError without a sequence, or for a damaged one."""
        check_folder(work.folder)
        sequences = self._sequences(work.folder)
        table = self._table(sequences)
        robots, num_skipped = [], 0
        for index, (robot_id, sequence) in enumerate(sequences.items()):
            summary = self.write_log(
                sequence,
                work.new / f"{robot_id}.mcap",
                robot_id=robot_id,
                map_frame=self.map_frame,
                class_table=table,
                every=work.every,
                progress=_part(work.progress, index, len(sequences)),
            )
            num_skipped += summary.num_without_pose
            robots.append(RobotConfig(robot_id, (work.output.resolve() / f"{robot_id}.mcap",)))
        return Team(tuple(robots), table, num_skipped=num_skipped)

    def _sequences(self, folder: Path) -> dict[str, Path]:
        """Folder of each sequence by its robot's id."""
        places = {self._place(path) for level in _LEVELS for path in folder.glob(level + self.marker)}
        if not places:
            raise InputError(
                f"{folder}: no {self.marker} found, here or up to three folders below; {self.title} has {self.holds}"
            )
        found: dict[str, Path] = {}
        for place in sorted(places):
            parts = place.relative_to(folder).parts or (place.resolve().name,)
            robot_id = robot_name(None, Path(f"{'_'.join(parts)}.mcap"))
            if robot_id in found:
                raise InputError(f"{place}: its robot would have the name of '{found[robot_id]}'; rename one of them")
            found[robot_id] = place
        return found

    def _place(self, path: Path) -> Path:
        """Folder of the sequence in which a path fits the marker."""
        return path.parents[self.marker.count("/")]

    def _table(self, sequences: dict[str, Path]) -> ClassTable | None:
        """Class table of the first sequence with labels."""
        found = next((table for table in map(self.classes, sequences.values()) if table is not None), None)
        robots = (RobotConfig("a", (Path("a.mcap"),)),)
        return with_classes(RunConfig(robots), found).classes if isinstance(found, str) else found


def _part(progress: Callable[[float], None] | None, index: int, count: int) -> Callable[[float], None] | None:
    """Progress of one of several imports."""
    return None if progress is None else lambda share: progress((index + share) / count)
