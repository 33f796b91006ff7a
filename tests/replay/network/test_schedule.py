"""Schedules: states of robots and links over time."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from octoreplay.config.network import ScheduleEntry
from octoreplay.errors import ConfigError
from octoreplay.replay.network.schedule import Schedule
from support.long_suite import examples

NAMES = ("husky", "jackal", "spot", "warthog")


def _schedule(*entries, names=NAMES):
    return Schedule(entries, names)


def _links(matrix):
    np.testing.assert_array_equal(matrix, matrix.T)
    return [(int(i), int(j)) for i, j in np.argwhere(matrix) if i < j]


# --- by hand ---------------------------------------------------------------------------------------------------------


def test_an_entry_holds_from_its_start_up_to_its_end():
    schedule = _schedule(ScheduleEntry(10.0, 20.0, robots_off=("spot",), robots_silent=("husky",)))
    assert schedule.change_times == (10.0, 20.0)
    for elapsed_s, holds in ((0.0, False), (9.999, False), (10.0, True), (19.999, True), (20.0, False)):
        available = schedule.at(elapsed_s)
        assert available.robots_off.tolist() == [False, False, holds, False]
        assert available.robots_silent.tolist() == [holds, False, False, False]
        assert available.is_undisturbed == (not holds)


def test_an_entry_without_an_end_holds_forever():
    schedule = _schedule(ScheduleEntry(5.0, links_down=(("spot", "husky"),)))
    assert schedule.change_times == (5.0,)
    assert _links(schedule.at(1e9).links_down) == [(0, 2)]
    assert _links(schedule.at(1e9).links_up) == []


def test_groups_cut_the_links_between_them_only():
    schedule = _schedule(ScheduleEntry(0.0, 1.0, groups=(("warthog", "husky"), ("jackal",))))
    assert _links(schedule.at(0.0).links_down) == [(0, 1), (1, 3)]  # spot is in no group
    three = _schedule(ScheduleEntry(0.0, groups=(("husky",), ("spot",), (), ("jackal", "warthog"))))
    assert _links(three.at(0.0).links_down) == [(0, 1), (0, 2), (0, 3), (1, 2), (2, 3)]


def test_successive_entries():
    schedule = _schedule(
        ScheduleEntry(20.0, 30.0, links_up=(("husky", "spot"),)),
        ScheduleEntry(10.0, 20.0, links_down=(("spot", "husky"), ("spot", "jackal"))),
    )
    assert schedule.change_times == (10.0, 20.0, 30.0)
    before, after = schedule.at(19.5), schedule.at(20.0)
    assert (_links(before.links_down), _links(before.links_up)) == ([(0, 2), (1, 2)], [])
    assert (_links(after.links_down), _links(after.links_up)) == ([], [(0, 2)])


def test_entries_of_robots_and_of_their_links_do_not_conflict():
    schedule = _schedule(
        ScheduleEntry(0.0, 10.0, robots_off=("husky",)), ScheduleEntry(5.0, 15.0, links_up=(("husky", "spot"),))
    )
    available = schedule.at(7.0)
    assert available.robots_off[0]
    assert _links(available.links_up) == [(0, 2)]


def test_the_state_is_reused_between_changes_and_read_only():
    schedule = _schedule(ScheduleEntry(1.0, 2.0, robots_off=("spot",)))
    assert schedule.at(1.0) is schedule.at(1.9)
    assert schedule.at(0.0) is not schedule.at(2.0)
    with pytest.raises(ValueError, match="read-only"):
        schedule.at(1.0).robots_off[0] = True


def test_an_empty_schedule_changes_nothing():
    schedule = _schedule()
    assert schedule.change_times == ()
    assert schedule.at(3.0).is_undisturbed
    assert not schedule.forgets(-math.inf, math.inf).any()
    assert schedule.keeps(0, 1.0, 2.0)


def test_robots_forget_when_they_go_off():
    schedule = _schedule(
        ScheduleEntry(0.0, 1.0, robots_off=("jackal",), forget=True),
        ScheduleEntry(10.2, 10.7, robots_off=("spot",), forget=True),
        ScheduleEntry(10.2, 15.0, robots_off=("husky",)),
    )
    assert schedule.forgets(-math.inf, 0.0).tolist() == [False, True, False, False]
    assert schedule.forgets(0.0, 10.0).tolist() == [False] * 4
    assert schedule.forgets(10.0, 11.0).tolist() == [False, False, True, False]  # back before the tick sees it
    assert schedule.forgets(10.2, 11.0).tolist() == [False] * 4
    assert schedule.forgets(10.0, 10.2).tolist() == [False, False, True, False]


def test_robots_hold_the_scans_since_their_last_restart():
    schedule = _schedule(
        ScheduleEntry(10.0, 20.0, robots_off=("husky", "spot")),
        ScheduleEntry(30.0, 40.0, robots_off=("spot",), forget=True),
    )
    husky, jackal, spot = 0, 1, 2
    assert [schedule.keeps(husky, scan, 50.0) for scan in (9.9, 10.0, 19.9, 20.0)] == [True, False, False, True]
    assert schedule.keeps(jackal, 15.0, 50.0)
    assert schedule.keeps(spot, 25.0, 29.9)
    assert not schedule.keeps(spot, 25.0, 30.0)
    assert not schedule.keeps(spot, 35.0, 50.0)
    assert schedule.keeps(spot, 40.0, 50.0)


# --- errors ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ([ScheduleEntry(3.0, 4.0)], r"the entry from 3 s to 4 s has no effect; give it groups, links_down"),
        ([ScheduleEntry(3.0, links_down=(("spot", "spot"),))], r"'spot' cannot have a link to itself \(from 3 s on\)"),
        ([ScheduleEntry(3.0, links_up=(("spot", "spot"),))], r"'spot' cannot have a link to itself"),
        ([ScheduleEntry(3.0, groups=(("spot", "husky"),))], r"one group alone cuts no link \(from 3 s on\); list"),
        ([ScheduleEntry(3.0, groups=((), ()))], r"one group alone cuts no link"),
        (
            [ScheduleEntry(3.0, 5.0, groups=(("spot", "husky"), ("jackal", "spot")))],
            r"'spot' is in two groups from 3 s to 5 s; list it in one group",
        ),
        (
            [ScheduleEntry(20.0, robots_silent=("spot",)), ScheduleEntry(0.0, 30.0, robots_off=("husky", "spot"))],
            r"robot .spot. is in two entries at 20 s \(from 0 s to 30 s, and from 20 s on\); end one before the other",
        ),
        (
            [
                ScheduleEntry(0.0, 30.0, groups=(("husky", "warthog"), ("jackal", "spot"))),
                ScheduleEntry(20.0, 25.0, links_up=(("spot", "husky"),)),
            ],
            r"link 'husky' - 'spot' is in two entries at 20 s",
        ),
        (
            [ScheduleEntry(0.0, 30.0, groups=(("husky",), ("spot",)), links_up=(("spot", "husky"),))],
            r"link 'husky' - 'spot' is in two entries at 0 s",
        ),
        ([ScheduleEntry(0.0, links_down=(("spot", "husky"), ("husky", "spot")))], "'husky' - 'spot' is in two entries"),
        ([ScheduleEntry(0.0, robots_off=("spot",), robots_silent=("spot",))], r"robot 'spot' is in two entries"),
    ],
)  # fmt: skip
def test_invalid_schedules_are_refused(entries, message):
    with pytest.raises(ConfigError, match=rf"^schedule: .*{message}") as caught:
        _schedule(*entries)
    assert "\n" not in str(caught.value)


# --- properties ------------------------------------------------------------------------------------------------------

_TIMES = st.integers(0, 8).map(float)
_ROBOTS = st.lists(st.sampled_from(NAMES), max_size=2, unique=True).map(tuple)
_PAIRS = st.lists(st.sampled_from(list(itertools.permutations(NAMES, 2))), max_size=1).map(tuple)


@st.composite
def _entries(draw):
    start, end = draw(st.tuples(_TIMES, _TIMES | st.just(math.inf)).filter(lambda span: span[0] < span[1]))
    off = draw(_ROBOTS)
    split = draw(st.integers(0, 3))
    order = draw(st.permutations(NAMES))
    return ScheduleEntry(
        start, end,
        groups=(tuple(order[:split]), tuple(order[split : split + 1])) if split else (),
        links_down=draw(_PAIRS), links_up=draw(_PAIRS),
        robots_off=off, robots_silent=draw(_ROBOTS), forget=bool(off) and draw(st.booleans()),
    )  # fmt: skip


def _subjects(entry):
    """Robots and links of an entry, repeated as often as the entry names them."""
    found = [*entry.robots_off, *entry.robots_silent]
    found += [frozenset(pair) for pair in (*entry.links_down, *entry.links_up)]
    for pair in itertools.combinations(NAMES, 2):
        sides = [[k for k, group in enumerate(entry.groups) if name in group] for name in pair]
        if sides[0] and sides[1] and sides[0] != sides[1]:
            found.append(frozenset(pair))
    return found


def _holds(entry, elapsed_s):
    return entry.start <= elapsed_s < entry.end


@examples(100)
@given(st.lists(_entries(), max_size=4))
def test_the_state_at_every_time_follows_from_the_entries(entries):
    times = [k / 2 for k in range(20)]
    assume(all(_subjects(entry) for entry in entries))
    holding = {t: [entry for entry in entries if _holds(entry, t)] for t in times}
    twice = any(
        len(subjects := [s for entry in holding[t] for s in _subjects(entry)]) > len(set(subjects)) for t in times
    )
    if twice:
        with pytest.raises(ConfigError, match="is in two entries"):
            _schedule(*entries)
        return
    schedule = _schedule(*entries)
    for t, (i, name) in itertools.product(times, enumerate(NAMES)):
        available, now = schedule.at(t), holding[t]
        assert available.robots_off[i] == any(name in entry.robots_off for entry in now)
        assert available.robots_silent[i] == any(name in entry.robots_silent for entry in now)
        for j, other in enumerate(NAMES):
            pair = frozenset((name, other))
            up = any(pair == frozenset(link) for entry in now for link in entry.links_up)
            assert available.links_up[i, j] == up
            assert available.links_down[i, j] == (not up and any(pair in _subjects(entry) for entry in now))
    # A robot that forgets in (s, t] has at t nothing from before it forgot.
    for s, t in itertools.pairwise(times):
        for i in np.flatnonzero(schedule.forgets(s, t)):
            assert not schedule.keeps(i, s, t)
