"""The command 'query'."""

from __future__ import annotations

import json
import re
from pathlib import Path

from octoreplay.result import open_result
from support.command_line import octoreplay


def test_points_and_a_box(pair_result: Path) -> None:
    with open_result(pair_result) as opened:
        stored = opened.map("husky_1")
        leaves = stored.leaves()
        index = int(leaves.log_odds.max(axis=1).argmax())
        x, y, z = leaves.centers[index]
        name = opened.class_table.names[int(leaves.log_odds[index].argmax())]
    done = octoreplay(
        "query", pair_result, "--point", x, y, z, "--point", 1e6, 0, 0, "--box", *(-100.0,) * 3, *(100.0,) * 3
    )
    assert done.returncode == 0, done.stderr
    assert re.search(rf"\d\d %  {name} \d+\.\d\d %", done.stdout)
    assert re.search(r"1e\+06, 0, 0 +unknown", done.stdout)
    assert "log-odds" not in done.stdout
    assert "m\u00b3" in done.stdout


def test_the_posterior_is_shown_and_the_mean_on_request(pair_result: Path) -> None:
    with open_result(pair_result) as opened:
        stored = opened.map("husky_1")
        table = stored.leaves()
    place = table.centers[int(table.log_odds.max(axis=1).argmax())]
    for arguments, title, map_kind in (
        ((), "posterior of 2 robots", "posterior"), (("--map", "posterior"), "posterior of 2 robots", "posterior"),
        (("--map", "mean"), "mean of 2 robots", "mean"),
    ):  # fmt: skip
        text = octoreplay("query", pair_result, "--point", *place, *arguments).stdout
        assert f"({title}, frame team)" in text
        assert f"{100 * stored.query([place], map_kind=map_kind).probabilities.max():.2f} %" in text
    assert "(centralised map, frame team)" in octoreplay(
        "query", pair_result, "--point", *place, "--robot", "central"
    ).stdout  # fmt: skip
    removed = octoreplay("query", pair_result, "--point", *place, "--team-posterior")
    assert removed.returncode == 2
    assert "No such option '--team-posterior': the posterior of the team is the default; '--map mean'" in removed.stderr


def test_log_odds_are_shown_on_request(pair_result: Path) -> None:
    with open_result(pair_result) as opened:
        stored = opened.map("husky_1")
        place = stored.leaves().centers[0]
        log_odds = stored.query([place]).log_odds[0]
        names = opened.class_table.names
    for option in ("--log-odds", "-v"):
        text = octoreplay("query", pair_result, "--point", *place, option).stdout
        for name, value in zip(names, log_odds, strict=True):
            assert re.search(rf"{name} +[\d.]+ % +{value:.3f}", text)


def test_the_document_has_every_class(pair_result: Path) -> None:
    with open_result(pair_result) as opened:
        stored = opened.map("husky_1")
        place = stored.leaves().centers[0]
        answer = stored.query([place])
        names = opened.class_table.names
    done = octoreplay("query", pair_result, "--point", *place, "--point", 1e6, 0, 0, "--json", "-q")
    assert done.stderr == ""
    document = json.loads(done.stdout)
    known, unknown = document["points"]
    assert unknown == {"point": [1e6, 0.0, 0.0], "known": False}
    assert known["p_occupied"] + known["p_free"] == 1.0
    assert known["classes"] == dict(zip(names, answer.probabilities[0, 1:].tolist(), strict=True))
    assert known["log_odds"] == dict(zip(names, answer.log_odds[0].tolist(), strict=True))
    assert document["box"] is None
