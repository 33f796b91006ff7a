"""The schedule of a run: which robots and links are down, and when.

Times are seconds since the run's start t_0. An entry holds from its start up to, but not with, its end.
"""

from __future__ import annotations

import itertools
import math
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from octoreplay.config.network import ScheduleEntry
from octoreplay.errors import ConfigError
from octoreplay.records import BoolArray, read_only


@dataclass(frozen=True, eq=False)
class Availability:
    """What the schedule says at one time. All arrays are bool and read-only.

    ``robots_off`` (N,) neither map nor talk, ``robots_silent`` (N,) hear and do not talk. ``links_down`` and
    ``links_up`` (N, N) are symmetric and name no link both; a partition into groups is in ``links_down``.
    """

    robots_off: BoolArray
    robots_silent: BoolArray
    links_down: BoolArray
    links_up: BoolArray

    @cached_property
    def is_undisturbed(self) -> bool:
        """True when the schedule says nothing at this time."""
        return not any(part.any() for part in (self.robots_off, self.robots_silent, self.links_down, self.links_up))


class Schedule:
    """What is up or down over a run.

    ``entries`` may overlap where they speak of different robots and links. A robot that is off and one of its links may
    be in two entries at a time; the robot has no links then. ``change_times`` are the times at which anything starts or
    ends, ascending.

    Raises ConfigError for an entry that says nothing, a robot in two groups of an entry, a link from a robot to itself,
    and a robot or link that two entries speak of at a time.
    """

    def __init__(self, entries: Sequence[ScheduleEntry], robot_ids: Sequence[str]) -> None:
        self._entries = tuple(entries)
        self._robot_ids = tuple(robot_ids)
        self._index_of = {robot_id: index for index, robot_id in enumerate(robot_ids)}
        for entry in self._entries:
            _check_entry(entry)
        _check_overlaps(self._entries)
        ends = {entry.end for entry in self._entries if entry.end < math.inf}
        self.change_times: tuple[float, ...] = tuple(sorted({entry.start for entry in self._entries} | ends))
        self._availabilities: dict[int, Availability] = {}

    def at(self, elapsed_s: float) -> Availability:
        """What is up or down at a time; the same object until the next change."""
        number = bisect_right(self.change_times, elapsed_s)
        if number not in self._availabilities:
            self._availabilities[number] = self._availability(elapsed_s)
        return self._availabilities[number]

    def forgets(self, after_s: float, until_s: float) -> BoolArray:
        """The robots (N,) that begin to be off, and forget, in (after_s, until_s].

        An interval finds also what is shorter than a tick. Tick k asks for (t_k-1, t_k], the first one for (-inf, t_0].
        """
        found = np.zeros(len(self._robot_ids), dtype=bool)
        for entry in self._entries:
            if entry.forget and after_s < entry.start <= until_s:
                found[self._indices(entry.robots_off)] = True
        return found

    def keeps(self, robot_index: int, scan_s: float, elapsed_s: float) -> bool:
        """True when a robot has at ``elapsed_s`` what it scanned at ``scan_s``: it was on, and has not forgotten since.

        With ``forgets`` this gives the right memory to a robot that goes off and comes back between two ticks.
        """
        robot_id = self._robot_ids[robot_index]
        for entry in self._entries:
            if robot_id in entry.robots_off:
                if entry.start <= scan_s < entry.end:
                    return False
                if entry.forget and scan_s < entry.start <= elapsed_s:
                    return False
        return True

    def _availability(self, elapsed_s: float) -> Availability:
        """The entries that hold at a time, as arrays."""
        num_robots = len(self._robot_ids)
        off, silent = np.zeros((2, num_robots), dtype=bool)
        down, up = np.zeros((2, num_robots, num_robots), dtype=bool)
        for entry in self._entries:
            if not entry.start <= elapsed_s < entry.end:
                continue
            off[self._indices(entry.robots_off)] = True
            silent[self._indices(entry.robots_silent)] = True
            for matrix, links in ((down, (*entry.links_down, *_cut_links(entry))), (up, entry.links_up)):
                for a, b in links:
                    i, j = self._indices((a, b))
                    matrix[i, j] = matrix[j, i] = True
        return Availability(read_only(off), read_only(silent), read_only(down), read_only(up))

    def _indices(self, robot_ids: Sequence[str]) -> list[int]:
        """The indices of some robots."""
        return [self._index_of[robot_id] for robot_id in robot_ids]


def _cut_links(entry: ScheduleEntry) -> Iterator[tuple[str, str]]:
    """Every link between robots of different groups."""
    for one, other in itertools.combinations(entry.groups, 2):
        yield from itertools.product(one, other)


def _check_entry(entry: ScheduleEntry) -> None:
    """Refuse what one entry cannot say."""
    links = (*entry.links_down, *entry.links_up)
    if not (entry.groups or links or entry.robots_off or entry.robots_silent):
        raise ConfigError(
            f"schedule: the entry {_span(entry)} says nothing; give it groups, links_down, links_up, robots_off or"
            " robots_silent, or leave it out"
        )
    for a, b in links:
        if a == b:
            raise ConfigError(f"schedule: '{a}' cannot have a link to itself ({_span(entry)}); name two robots")
    if entry.groups and sum(map(bool, entry.groups)) < 2:
        raise ConfigError(
            f"schedule: one group alone cuts no link ({_span(entry)}); name the robots on the other side in a second"
        )
    seen: set[str] = set()
    for robot_id in itertools.chain(*entry.groups):
        if robot_id in seen:
            raise ConfigError(f"schedule: '{robot_id}' is twice in the groups {_span(entry)}; name it in one group")
        seen.add(robot_id)


def _check_overlaps(entries: Sequence[ScheduleEntry]) -> None:
    """Refuse a robot or link that is spoken of twice at a time, by one entry or by two."""
    spoken: dict[tuple[str, ...], list[ScheduleEntry]] = {}
    for entry in entries:
        for subject in _subjects(entry):
            spoken.setdefault(subject, []).append(entry)
    for subject, claims in spoken.items():
        claims.sort(key=lambda entry: entry.start)
        # Sorted by start, the first overlap there is lies between two that follow each other.
        for earlier, later in itertools.pairwise(claims):
            if later.start < earlier.end:
                what = f"robot '{subject[0]}'" if len(subject) == 1 else f"link '{subject[0]}' - '{subject[1]}'"
                raise ConfigError(
                    f"schedule: {what} is in it twice at {later.start:g} s ({_span(earlier)}, and {_span(later)});"
                    " end the one before the other starts, or leave one out"
                )


def _subjects(entry: ScheduleEntry) -> Iterator[tuple[str, ...]]:
    """The robots (r,) and the links (a, b), a < b, that an entry speaks of."""
    for robot_id in (*entry.robots_off, *entry.robots_silent):
        yield (robot_id,)
    for a, b in (*entry.links_down, *entry.links_up, *_cut_links(entry)):
        yield (min(a, b), max(a, b))


def _span(entry: ScheduleEntry) -> str:
    """When an entry holds, in words."""
    return f"from {entry.start:g} s " + ("on" if entry.end == math.inf else f"to {entry.end:g} s")
