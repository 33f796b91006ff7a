"""The command 'query'."""

from __future__ import annotations

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
    done = octoreplay("query", pair_result, "--at", x, y, z, "--at", 1e6, 0, 0, "--box", *(-100.0,) * 3, *(100.0,) * 3)
    assert done.returncode == 0, done.stderr
    assert re.search(rf"{name} +\d+\.\d\d %", done.stdout)
    assert re.search(r"1e\+06, 0, 0 +unknown", done.stdout)
    assert "m\u00b3" in done.stdout
