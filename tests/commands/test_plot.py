"""The command 'plot'."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from octoreplay.errors import ConfigError
from octoreplay.result import open_result
from support.command_line import assert_fails, octoreplay
from support.fixture_paths import FIXTURES
from support.long_suite import long

RESULT, OTHER = FIXTURES / "result_3.mcap", FIXTURES / "result_2.mcap"


def test_a_figure_of_two_results(tmp_path: Path) -> None:
    out = tmp_path / "fig.pdf"
    done = octoreplay("plot", RESULT, OTHER, "--what", "phi", "--label", "a", "--label", "b$", "-o", out)
    assert (done.returncode, done.stdout) == (0, f"wrote {out}\n")
    assert out.read_bytes().startswith(b"%PDF")


def test_refused_figures_write_nothing(tmp_path: Path) -> None:
    out = tmp_path / "fig.png"
    (tmp_path / "no.mcap").write_bytes(b"no result")
    phi = ("--what", "phi", "-o", out)
    for code, sentence, arguments in (
        (2, r"must end in \.pdf or \.png or \.svg", (RESULT, "--what", "phi", "-o", tmp_path / "fig.gif")),
        (2, "two results have the label 'result_3'; name each with --label", (RESULT, RESULT, *phi)),
        (2, "two results have the label 'x'", (RESULT, OTHER, "--label", "x", "--label", "x", *phi)),
        (2, "label: expects one for each of the 2 results, got 1", (RESULT, OTHER, "--label", "x", *phi)),
        (2, "--robot belongs to --what map; leave it out for --what phi", (RESULT, "--robot", "a", *phi)),
        (2, "--max-depth belongs to --what map; leave it out for --what phi", (RESULT, "--max-depth", 18, *phi)),
        (1, "no.mcap", (RESULT, tmp_path / "no.mcap", *phi)),
        (2, "must end in", (RESULT, "--what", "phi", "-o", RESULT)),
        (1, "robot 'x' not found", (RESULT, "--what", "map", "--robot", "x", "-o", out)),
    ):
        assert_fails(code, sentence, "plot", *arguments)
    assert [path.name for path in tmp_path.iterdir()] == ["no.mcap"]


def test_python_draws_the_same_figure() -> None:
    with open_result(RESULT) as result, open_result(OTHER) as other:
        figure = result.plot("phi", label="a", beside={"b": other})
        names = [text.get_text() for text in figure.legends[0].get_texts()]
        assert {name.partition(" (")[0] for name in names} >= {"a", "b"}
        with pytest.raises(ConfigError, match="what: 'map2' is not one of phi, packets"):
            result.plot("map2")
        with pytest.raises(ConfigError, match="style: 'a0' is not one of screen, one-column"):
            result.plot("phi", style="a0")


@long
def test_pictures_of_maps_have_the_pixels_of_a_paper(tmp_path: Path) -> None:
    with open_result(RESULT) as result:
        picture = result.plot("map", style="one-column")
    picture.savefig(tmp_path / "map.png")
    with Image.open(tmp_path / "map.png") as image:
        assert image.width == 1050
        assert len(np.unique(np.asarray(image.convert("RGB")).reshape(-1, 3), axis=0)) > 20
