"""Alignment of a team with known transforms from its logs: position fixes and tags."""

from __future__ import annotations

import math

import numpy as np
import pytest

from octoreplay.geodesy import geodetic_points
from octoreplay.io.robots.sightings import Fixes, Sightings
from octoreplay.registration import pairs
from octoreplay.replay.alignment import Alignment, align_robots
from octoreplay.transforms import inverse, pose_difference
from support.long_suite import long
from support.village_maps import T_village_map, empty_map, team_config, village_map

PLACES = {"ant": ((-2.0, 0.0), 0), "bee": ((3.0, 3.0), 1)}
TRUTH = {name: T_village_map(center, turns=turns) for name, (center, turns) in PLACES.items()}
ORIGIN = np.array([48.0, 11.0, 500.0])
NO_FIXES = Fixes(np.empty(0), np.empty((0, 3)), np.empty((0, 2)), np.empty((0, 3)))
NOTHING = Sightings(NO_FIXES, {})


@pytest.fixture(scope="module")
def maps():
    return [village_map(center, 13.0, turns=turns) for center, turns in PLACES.values()]


@pytest.fixture
def without_search(monkeypatch):
    """The maps give no candidates."""
    monkeypatch.setattr(pairs, "planar_candidates", lambda first, second: [])


def fixes_of(T_enu_map, *, sigma=0.5, bias=(0.0, 0.0, 0.0), seed=0) -> Sightings:
    """Fixes along a way of 25 m, of a robot whose map frame is at a pose, with random errors and a common one."""
    s = np.linspace(-1.0, 1.0, 40)
    points = np.stack([8.0 * s, 6.0 * s**2, np.full(40, 0.5)], axis=1)
    enu = points @ T_enu_map[:3, :3].T + T_enu_map[:3, 3] + np.random.default_rng(seed).normal(bias, sigma, (40, 3))
    return Sightings(Fixes(np.arange(40.0), geodetic_points(enu, ORIGIN), np.full((40, 2), sigma), points), {})


def tags_of(T_team_map, tags) -> Sightings:
    return Sightings(NO_FIXES, {name: np.array([inverse(T_team_map) @ T] * 3) for name, T in tags.items()})


def tag(x, y, yaw):
    T = np.eye(4)
    T[:2, :2] = [[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]]
    T[:3, 3] = x, y, 1.0
    return T


TAGS = {"3": tag(1.0, 2.0, 0.4), "7": tag(4.0, -2.0, 2.0)}


def aligned(maps, *sightings, dof=4, names=("ant", "bee")) -> Alignment:
    return align_robots(team_config(*names), maps, sightings=sightings, dof=dof, num_threads=1)


def assert_right(alignment):
    _, bee = alignment.teams[0]
    shift, angle = pose_difference(bee.T_team_map, inverse(TRUTH["ant"]) @ TRUTH["bee"])
    assert shift < 0.05
    assert math.degrees(angle) < 0.2
    return bee


@long
def test_fixes_lead_to_the_frame_where_the_search_fails(maps, without_search):
    assert aligned(maps, NOTHING, NOTHING).left_out == ("bee",)
    for sigma, bias in ((0.1, (0.0, 0.0, 0.0)), (0.8, (1.2, -0.8, 4.0))):
        sightings = [fixes_of(TRUTH["ant"], sigma=sigma, seed=1), fixes_of(TRUTH["bee"], sigma=sigma, bias=bias)]
        bee = assert_right(aligned(maps, *sightings))
        assert bee.origin.startswith("aligned with ant")
        assert bee.origin.endswith("; agrees with position fixes")


def test_a_first_fix_far_away_changes_nothing(maps, without_search):
    sightings = [fixes_of(T) for T in TRUTH.values()]
    sightings[0].fixes.geodetic[0] = (-20.0, 150.0, 0.0)
    assert assert_right(aligned(maps, *sightings)).origin.endswith("; agrees with position fixes")


@pytest.mark.parametrize("names", [("3",), ("3", "7")])
def test_tags_lead_to_the_frame_where_the_search_fails(maps, without_search, names):
    tags = {name: TAGS[name] for name in names}
    bee = assert_right(aligned(maps, *(tags_of(T, tags) for T in TRUTH.values())))
    assert bee.origin.endswith(f"; agrees with sightings of tag{'s' * (len(names) > 1)} {', '.join(names)}")


def test_wrong_fixes_give_no_frame(maps, without_search):
    wrong = T_village_map((9.0, -6.0), turns=2)
    alignment = aligned(maps, fixes_of(TRUTH["ant"]), fixes_of(wrong))
    assert alignment.left_out == ("bee",)
    assert alignment.notes == ("position fixes place bee near ant, but are not used: the maps do not confirm it",)


def test_fixes_that_differ_from_the_maps_are_named(maps):
    alignment = aligned(maps, fixes_of(TRUTH["ant"]), fixes_of(T_village_map((9.0, -6.0), turns=2)))
    bee = assert_right(alignment)
    assert "agrees" not in bee.origin
    (note,) = alignment.notes
    assert note.startswith("bee is aligned with ant 8.")
    assert note.endswith("degrees from where position fixes place it: one is wrong")


def test_fixes_explain_why_maps_cannot_overlap(maps, without_search):
    alignment = aligned(maps, fixes_of(np.eye(4)), fixes_of(T_village_map((120.0, 0.0), turns=1)))
    assert alignment.left_out == ("bee",)
    (note,) = alignment.notes
    assert note.startswith("position fixes place bee at least 9")
    assert note.endswith(" m from ant: their maps cannot overlap")


def test_places_that_relate_no_robots_are_named_and_change_nothing(maps, without_search):
    still = Sightings(
        Fixes(np.arange(9.0), np.tile(ORIGIN, (9, 1)), np.ones((9, 2)), np.zeros((9, 3))), {}, ("a sentence on a log",)
    )
    too_short = "the position fixes of ant are not used: a way of 0.0 m is too short for fixes that scatter by 0.01 m"
    moved = Sightings(NO_FIXES, {"3": np.array([*[np.eye(4)] * 5, *[tag(8.0, 0.0, 0.0)] * 5])})
    for sightings, notes in (
        ((tags_of(TRUTH["ant"], {"3": TAGS["3"]}), tags_of(TRUTH["bee"], {"7": TAGS["7"]})), ()),
        ((fixes_of(TRUTH["ant"]), NOTHING), ()),
        (
            (still, fixes_of(TRUTH["bee"])),
            (
                "a sentence on a log",
                too_short,
            ),
        ),
        (
            (tags_of(TRUTH["ant"], TAGS), moved),
            ("tag 3 of bee is not used: it was seen at places over 1 m apart",),
        ),
    ):
        alignment = aligned(maps, *sightings)
        assert alignment.notes == notes
        assert alignment.left_out == ("bee",)


def test_fixes_need_a_vertical_axis():
    alignment = aligned([empty_map(), empty_map()], fixes_of(TRUTH["ant"]), fixes_of(TRUTH["bee"]), dof=6)
    assert "position fixes are not used: they need map frames with a vertical z axis (--dof 4)" in alignment.notes


def test_empty_maps_are_refused_in_spite_of_known_places():
    sightings = [Sightings(fixes_of(T).fixes, tags_of(T, TAGS).tags) for T in TRUTH.values()]
    alignment = aligned([empty_map(), empty_map()], *sightings)
    assert alignment.left_out == ("bee",)
    assert "position fixes place bee near ant, but are not used: the maps do not confirm it" in alignment.notes
