"""Alignment of a team from its robots' maps: frames, candidates, given poses, configuration, tables and files."""

from __future__ import annotations

import csv
import dataclasses
import json
import math
import re
from pathlib import Path

import numpy as np
import pytest

from octoreplay.config.robot import RobotConfig
from octoreplay.config.team_file import dump_team, parse_team
from octoreplay.errors import ConfigError, InputError
from octoreplay.io.text_files import json_text
from octoreplay.replay.alignment import Alignment, align_robots, aligned_config, check_aligned
from octoreplay.report.alignment_files import PAIR_COLUMNS, alignment_content, write_alignment
from octoreplay.report.alignment_plots import pair_figure, team_figure, write_alignment_figures
from octoreplay.report.alignment_tables import alignment_tables, pair_numbers
from octoreplay.report.tables import terminal
from octoreplay.transforms import inverse, numbers_of, pose_difference
from support.long_suite import long
from support.village_maps import T_village_map, empty_map, team_config, village_map

PLACES = {"ant": ((-2.0, 0.0), 0), "bee": ((3.0, 3.0), 1), "cow": ((2.0, -4.0), 2)}
TRUTH = {name: T_village_map(center, turns=turns) for name, (center, turns) in PLACES.items()}
IDS = (*PLACES, "dog")


@pytest.fixture(scope="module")
def maps():
    """Maps of three robots of one village, and an empty one."""
    return [*(village_map(center, 13.0, turns=turns) for center, turns in PLACES.values()), empty_map()]


@pytest.fixture(scope="module")
def alignment(maps) -> Alignment:
    return align_robots(team_config(*IDS), maps)


def errors(alignment: Alignment, T_team_village: np.ndarray) -> list[tuple[float, float]]:
    """Errors [m, rad] of the robots of the first team."""
    return [pose_difference(f.T_team_map, T_team_village @ TRUTH[f.robot_id]) for f in alignment.teams[0]]


def test_frames_are_those_of_the_village(alignment):
    assert [frame.robot_id for frame in alignment.teams[0]] == ["ant", "bee", "cow"]
    for shift, angle in errors(alignment, inverse(TRUTH["ant"])):
        assert shift < 0.05
        assert math.degrees(angle) < 0.2
    first, second, _ = alignment.teams[0]
    assert (first.origin, first.sigma) == ("frame of the team", None)
    assert second.origin.startswith(f"aligned with {second.partner}")
    assert second.sigma is not None
    assert min(second.sigma) > 0
    assert max(second.sigma) < 0.5


def test_the_frames_are_a_table(alignment):
    table = alignment.as_table()
    frames = [frame for team in alignment.teams for frame in team]
    assert table["robot_id"].tolist() == [frame.robot_id for frame in frames]
    assert table["team"].tolist() == [index for index, team in enumerate(alignment.teams) for _ in team]
    assert table["partner"].tolist() == [frame.partner or "" for frame in frames]
    assert [tuple(row[name] for name in ("x", "y", "z", "qx", "qy", "qz", "qw")) for row in table.to_numpy()] == [
        numbers_of(frame.T_team_map) for frame in frames
    ]
    assert np.isnan(table["sigma_x"][0])
    assert (table["sigma_x"][1], table["sigma_rz"][1]) == (frames[1].sigma[0], frames[1].sigma[5])


def test_a_robot_without_a_map_is_left_out_and_named(alignment):
    assert alignment.left_out == ("dog",)
    assert not alignment.is_whole
    assert any("dog is not connected" in s and "fewer than 150" in s for s in alignment.warnings)
    assert any("map of dog is empty" in sentence for sentence in alignment.notes)


@long
def test_maps_in_a_known_frame_give_the_frames_of_the_robots(maps):
    T_map_own = [T_village_map((1.0, 2.0), turns=turns) for turns in (1, 2)]
    shares = []
    plain = align_robots(team_config("ant", "bee"), maps[:2], num_threads=1)
    placed = align_robots(
        team_config("ant", "bee"), maps[:2], T_map_own=T_map_own, progress=shares.append, num_threads=1
    )
    assert shares[-1] == 1.0
    for robot, T, before in zip(placed.teams[0], T_map_own, plain.teams[0], strict=True):
        expected = T_map_own[0] @ before.T_team_map @ inverse(T)
        assert pose_difference(robot.T_team_map, expected) == pytest.approx((0, 0), abs=1e-6)


def given(name, T):
    """A robot with a surveyed T_team_map."""
    return RobotConfig(name, (Path(f"{name}.mcap"),), T_team_map=numbers_of(T))


def test_given_poses_keep_the_team_frame_and_wrong_ones_are_named(maps):
    far, maps = T_village_map((100.0, 0.0)), [maps[0], maps[2], maps[3]]
    wrong = T_village_map((5.0, 0.0)) @ TRUTH["cow"]
    robots = (given("ant", TRUTH["ant"]), given("cow", wrong), given("dog", far))
    aligned = align_robots(team_config(*robots), maps)
    placed = {frame.robot_id: frame for frame in aligned.teams[0]}
    assert list(placed) == ["ant", "cow", "dog"]
    assert placed["ant"].is_given
    assert placed["dog"].is_given
    assert not placed["cow"].is_given
    assert all(
        shift < 0.05 for shift, _ in errors(dataclasses.replace(aligned, teams=(aligned.teams[0][:2],)), np.eye(4))
    )
    (problem,) = aligned.problems
    assert problem.startswith("the T_team_map given for cow is not used: it disagrees with that of ant")
    assert any("dog keeps its given T_team_map, which no overlap" in note for note in aligned.notes)
    written = aligned_config(team_config(*robots), aligned.teams[0]).robots
    assert written[0] == robots[0]
    assert written[2] == robots[2]
    assert written[1].T_team_map_from == f"{placed['cow'].origin} ({placed['cow'].evidence})"


def test_a_guess_is_verified_and_never_trusted():
    empty = [empty_map(), empty_map()]
    guess = {"ant": numbers_of(np.eye(4)), "bee": numbers_of(T_village_map((1.0, 0.0)))}
    with pytest.raises(InputError, match="no two of the 2 robots could be aligned; the best pair is ant and bee"):
        check_aligned(align_robots(team_config("ant", "bee"), empty, guesses=guess))


@long
def test_each_guess_is_confirmed_or_named(maps):
    far = T_village_map((20.0, 0.0), turns=3)
    for guess, is_right in ((TRUTH["bee"], True), (far, False)):
        guesses = {"ant": numbers_of(TRUTH["ant"]), "bee": numbers_of(guess)}
        aligned = align_robots(team_config("ant", "bee"), maps[:2], guesses=guesses)
        assert aligned.teams[0][1].origin.endswith("; agrees with the guesses") == is_right
        assert len(aligned.notes) == (0 if is_right else 1)
    assert aligned.notes[0].startswith("bee is aligned with ant ")
    assert aligned.notes[0].endswith(" and 180.0 degrees from where the guesses place it: they are not used")
    (alone,) = align_robots(team_config("ant", "bee"), maps[:2], guesses={"bee": numbers_of(far)}).notes
    assert alone == "the guess for bee is not used: it needs that of another robot"


def test_a_given_pose_that_tilts_the_team_is_named(maps):
    upside_down = TRUTH["ant"] @ np.diag([1.0, -1.0, -1.0, 1.0])
    aligned = align_robots(team_config(given("ant", upside_down), "bee"), maps[:2])
    tilted = "the T_team_map given for ant tilts its z axis by 180 degrees; --dof 4 expects vertical axes"
    assert tilted in aligned.notes


def test_refusals_name_the_option_that_may_help():
    nothing = [empty_map(), empty_map()]
    for dof, remedy in (
        (4, "fewer than 150; where the z axis of a map is not vertical, use --dof 6 (docs"),
        (6, "fewer than 1600; finer cells may give enough (--resolution 0.15) (docs"),
    ):
        with pytest.raises(InputError, match=re.escape(remedy)):
            check_aligned(align_robots(team_config("ant", "bee"), nothing, dof=dof))


def test_equal_maps_are_aligned_exactly_and_named(maps):
    twins = align_robots(team_config("ant", "twin"), [maps[0], maps[0]])
    assert pose_difference(twins.teams[0][1].T_team_map, np.eye(4)) == pytest.approx((0, 0), abs=1e-6)
    assert twins.notes == ("ant and twin have equal maps: are their logs the same?",)


def test_one_robot_and_unknown_guesses_are_refused(maps):
    with pytest.raises(ConfigError, match="align: needs at least two robots; the team has one, ant"):
        align_robots(team_config("ant"), maps[:1])
    with pytest.raises(ConfigError, match="guess: robot 'eel' is not in the team: ant, bee"):
        align_robots(team_config("ant", "bee"), maps[:2], guesses={"eel": numbers_of(np.eye(4))})


def test_the_aligned_team_file_has_frames_and_deviations_and_loads_again(alignment):
    config = team_config(*IDS)
    config = dataclasses.replace(
        config, network=dataclasses.replace(config.network, one_way=(("ant", "bee"), ("dog", "ant")))
    )
    aligned = aligned_config(config, alignment.teams[0])
    assert [robot.robot_id for robot in aligned.robots] == ["ant", "bee", "cow"]
    assert aligned.network.one_way == (("ant", "bee"),)
    again = parse_team(dump_team(aligned), name="aligned.yaml", folder=Path())
    assert again == aligned
    assert again.robots[1].T_team_map == numbers_of(alignment.teams[0][1].T_team_map)
    assert again.robots[1].T_team_map_sigma == alignment.teams[0][1].sigma


def test_tables_show_every_pair_with_the_number_that_failed(alignment, capsys):
    terminal(width=160).print(alignment_tables(alignment))
    text = capsys.readouterr().out
    assert text.count("accepted") == 3
    assert text.count("refused") == 3
    assert "aligned with ant" in text


def test_the_table_of_many_pairs_ends_with_the_number_of_the_others(alignment, capsys):
    many = dataclasses.replace(alignment, pairs=alignment.pairs * 6)
    terminal(width=160).print(alignment_tables(many))
    assert "and 6 more pairs, of which 0 are accepted; --csv writes all" in capsys.readouterr().out


def test_files_hold_every_pair_and_frame(alignment, tmp_path):
    csv_path = tmp_path / "pairs.csv"
    assert write_alignment(alignment, csv_path) == [csv_path]
    rows = list(csv.DictReader(csv_path.read_text().splitlines()))
    assert tuple(rows[0]) == PAIR_COLUMNS
    assert [row["accepted"] for row in rows] == ["True", "True", "False", "True", "False", "False"]
    content = json.loads(json_text(alignment_content(alignment)))
    assert content["left_out"] == ["dog"]
    frame = content["components"][0][1]
    assert frame["T_team_map"] == list(numbers_of(alignment.teams[0][1].T_team_map))
    assert np.sqrt(np.diag(frame["covariance"])) == pytest.approx(frame["T_team_map_sigma"], abs=1e-6)
    assert len(content["pairs"]) == 6


@long
def test_figures_are_of_the_team_and_of_every_pair(alignment, tmp_path):
    written = write_alignment_figures(dataclasses.replace(alignment, pairs=alignment.pairs[:1]), tmp_path)
    assert written == [tmp_path / "team.png", tmp_path / "pair_ant_bee.png"]
    assert all(path.stat().st_size > 1000 for path in written)


def test_figures_name_robots_verdicts_and_frames_and_keep_the_colours(alignment):
    team = team_figure(alignment)
    assert team.get_suptitle() == "3 of 4 robots aligned"
    assert [text.get_text() for text in team.legends[0].get_texts()] == ["ant", "bee", "cow", "dog (left out)"]
    before, after = team.axes
    assert (before.get_xlabel(), after.get_xlabel()) == ("x [m], frames as configured", "x [m], map frame of ant")
    assert np.ptp(before.get_xlim()) == pytest.approx(np.ptp(after.get_xlim()))
    colors = [collection.get_facecolor()[0].tolist() for collection in after.collections[::2]]
    refused = next(pair for pair in alignment.pairs if not pair.is_accepted)
    for pair, title in ((alignment.pairs[1], "after"), (refused, "best pose (refused)")):
        figure = pair_figure(alignment, pair)
        first, second = IDS[pair.first], IDS[pair.second]
        assert figure.get_suptitle().startswith(
            f"{first} and {second}: {'accepted' if pair.is_accepted else 'refused'}"
        )
        assert figure.axes[1].get_title(loc="left") == title
        assert figure.axes[1].get_xlabel() == f"x [m], map frame of {first}"
        assert figure.axes[1].collections[0].get_facecolor()[0].tolist() == colors[pair.first]
    squares = figure.axes[0].collections[0].get_paths()[0].get_extents()
    assert (squares.width, squares.height) == pytest.approx((0.3, 0.3))


def test_without_a_vertical_axis_numbers_that_do_not_count_are_left_out(alignment):
    assert pair_numbers(alignment.pairs[0], 4)["L"] != "-"
    numbers = pair_numbers(alignment.pairs[0], 6)
    assert (numbers["q_g"], numbers["L"]) == ("-", "-")
    figure = team_figure(dataclasses.replace(alignment, dof=6))
    assert figure.axes[1].get_xlabel() == "longest extent [m], map frame of ant"
