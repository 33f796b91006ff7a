"""Part of the maps of a result that exports and pictures show."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from octoreplay.errors import InputError
from octoreplay.mapping.octree import KEY_BITS
from octoreplay.result import Result
from octoreplay.stored_map import StoredMap, joined_map


class MapPart(NamedTuple):
    """Time, region and level of detail of shown maps.

    ``at_ns`` is the time (None: the end), ``bounds`` are as in ``Result.map`` (empty: everywhere), and ``max_depth`` is
    as in ``StoredMap.coarsened`` (None: all cells).
    """

    at_ns: int | None = None
    bounds: Sequence[float] = ()
    max_depth: int | None = None

    def parts(self, result: Result) -> Iterator[MapPart]:
        """Yield the parts of this one that hold one tile each; the part itself for an ordinary result."""
        for bounds in result.boxes(self.bounds, max_depth=self.max_depth):
            yield self._replace(bounds=bounds)

    def map(self, result: Result, robot_id: str) -> StoredMap:
        """Return this part of a robot's map. Raises as ``Result.map`` and ``StoredMap.coarsened``."""
        if self.max_depth is None:
            return result.map(robot_id, at_ns=self.at_ns, bounds=self.bounds)
        # Each part becomes coarser before the next one is read.
        return joined_map(
            result.map(robot_id, at_ns=self.at_ns, bounds=part.bounds).coarsened(self.max_depth)
            for part in self.parts(result)
        )

    def evidence(self, result: Result, robot_id: str, *, tick: int | None = None) -> StoredMap:
        """Return this part of a robot's evidence, at a tick if one is given in place of the time.

        It has two more cells on every side, because the relation of two robots' evidence depends on neighbours. Raises
        as ``Result.evidence`` and ``StoredMap.coarsened``.
        """
        half, margin = len(self.bounds) // 2, 2 * finest_edge(result, self.max_depth)
        wider = [number - margin if index < half else number + margin for index, number in enumerate(self.bounds)]
        return result.evidence(robot_id, at_ns=self.at_ns, tick=tick, bounds=wider).coarsened(self.max_depth)

    def check_one_frame(self, result: Result) -> None:
        """Raise InputError where the robots' maps are in several frames."""
        maps = [self.map(result, robot_id) for robot_id in result.robots]
        if len({stored.frame_id for stored in maps}) > 1:
            frames = ", ".join(f"{stored.robot_id} in {stored.frame_id}" for stored in maps)
            raise InputError(
                f"{result.path}: the robots' maps are in different frames ({frames}); name a robot and color 'label' or"
                " 'probability', or a later time"
            )


def finest_edge(result: Result, max_depth: int | None) -> float:
    """Return the edge of the finest cells of maps down to a depth [m]; None is the depth of the run's cells."""
    return result.config.map.resolution * 2.0 ** (0 if max_depth is None else KEY_BITS - max_depth)
