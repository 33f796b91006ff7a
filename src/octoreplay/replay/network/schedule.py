"""Schedule of a run: robots and links that are down or up for some time.

Times are seconds since the run's start t_0. An entry holds in [start, end).
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
    """State of the schedule at one time. All arrays are bool and read-only.

    ``robots_off`` (N,) neither map nor send nor receive; ``robots_silent`` (N,) receive and do not send.
    ``links_down`` and ``links_up`` (N, N) are symmetric and have no link in common; a partition into groups is in
    ``links_down``.
    """

    robots_off: BoolArray
    robots_silent: BoolArray
    links_down: BoolArray
    links_up: BoolArray

    @cached_property
    def is_undisturbed(self) -> bool:
        """True when no entry holds at this time."""
        return not any(part.any() for part in (self.robots_off, self.robots_silent, self.links_down, self.links_up))


class Schedule:
    """Schedule over a run.

    Entries may overlap in time if they name different robots and links. A robot that is off and one of its links may
    be in two entries at a time; the robot has no links then. ``change_times`` are the starts and ends of all entries,
    ascending.

    Raises ConfigError for an entry without content, a robot in two groups of an entry, a link from a robot to itself,
    and a robot or link that two entries name at a time.
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
        """State at a time; the same object until the next change."""
        number = bisect_right(self.change_times, elapsed_s)
        if number not in self._availabilities:
            self._availabilities[number] = self._availability(elapsed_s)
        return self._availabilities[number]

    def forgets(self, after_s: float, until_s: float) -> BoolArray:
        """Robots (N,) bool that go off without keeping their memory in (after_s, until_s].

        The interval also finds entries shorter than a tick. Tick k asks for (t_k-1, t_k], tick 0 for (-inf, t_0].
        """
        found = np.zeros(len(self._robot_ids), dtype=bool)
        for entry in self._entries:
            if entry.forget and after_s < entry.start <= until_s:
                found[self._indices(entry.robots_off)] = True
        return found

    def keeps(self, robot_index: int, scan_s: float, elapsed_s: float) -> bool:
        """True when a robot was on at ``scan_s`` and has not lost its memory between then and ``elapsed_s``.

        With ``forgets`` this gives a robot that goes off and comes back between two ticks the right memory.
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
        """Arrays of the entries that hold at a time."""
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
        """Indices of robots."""
        return [self._index_of[robot_id] for robot_id in robot_ids]


def _cut_links(entry: ScheduleEntry) -> Iterator[tuple[str, str]]:
    """Links between robots of different groups."""
    for one, other in itertools.combinations(entry.groups, 2):
        yield from itertools.product(one, other)


def _check_entry(entry: ScheduleEntry) -> None:
    """Raise ConfigError for an entry that is invalid by itself."""
    links = (*entry.links_down, *entry.links_up)
    if not (entry.groups or links or entry.robots_off or entry.robots_silent):
        raise ConfigError(
            f"schedule: the entry {_span(entry)} has no effect; give it groups, links_down, links_up, robots_off or"
            " robots_silent, or remove it"
        )
    for a, b in links:
        if a == b:
            raise ConfigError(f"schedule: '{a}' cannot have a link to itself ({_span(entry)}); name two robots")
    if entry.groups and sum(map(bool, entry.groups)) < 2:
        raise ConfigError(
            f"schedule: one group alone cuts no link ({_span(entry)}); list the other robots in a second group"
        )
    seen: set[str] = set()
    for robot_id in itertools.chain(*entry.groups):
        if robot_id in seen:
            raise ConfigError(f"schedule: '{robot_id}' is in two groups {_span(entry)}; list it in one group")
        seen.add(robot_id)


def _check_overlaps(entries: Sequence[ScheduleEntry]) -> None:
    """Raise ConfigError for a robot or link that is named twice at a time."""
    entries_of: dict[tuple[str, ...], list[ScheduleEntry]] = {}
    for entry in entries:
        for subject in _subjects(entry):
            entries_of.setdefault(subject, []).append(entry)
    for subject, claims in entries_of.items():
        claims.sort(key=lambda entry: entry.start)
        # In the order of starts, the first overlap is between neighbours.
        for earlier, later in itertools.pairwise(claims):
            if later.start < earlier.end:
                what = f"robot '{subject[0]}'" if len(subject) == 1 else f"link '{subject[0]}' - '{subject[1]}'"
                raise ConfigError(
                    f"schedule: {what} is in two entries at {later.start:g} s ({_span(earlier)}, and {_span(later)});"
                    " end one before the other starts, or remove one"
                )


def _subjects(entry: ScheduleEntry) -> Iterator[tuple[str, ...]]:
    """Robots (r,) and links (a, b), a < b, that an entry names."""
    for robot_id in (*entry.robots_off, *entry.robots_silent):
        yield (robot_id,)
    for a, b in (*entry.links_down, *entry.links_up, *_cut_links(entry)):
        yield (min(a, b), max(a, b))


def _span(entry: ScheduleEntry) -> str:
    """Time span of an entry, in words."""
    return f"from {entry.start:g} s " + ("on" if entry.end == math.inf else f"to {entry.end:g} s")
