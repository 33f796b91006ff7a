"""The command 'metrics'."""

from __future__ import annotations

from pathlib import Path

from octoreplay.result import open_result
from support.command_line import octoreplay


def test_table_csv_and_figures(pair_result: Path, tmp_path: Path) -> None:
    done = octoreplay("metrics", pair_result, "--csv", tmp_path / "m.csv", "--plot", tmp_path / "figures")
    assert done.returncode == 0, done.stderr
    assert "agreement, worst robot" in done.stdout
    assert "wall time" not in done.stdout
    with open_result(pair_result) as opened:
        assert len((tmp_path / "m.csv").read_text().splitlines()) == len(opened.metrics) + 1
    names = ["agreement.png", "contradiction.png", "disagreement.png", "packet_size.png"]
    assert sorted(path.name for path in (tmp_path / "figures").iterdir()) == names
    assert "any contradiction" in done.stdout
