"""The tutorial's commands work as printed."""

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

from support.long_suite import long

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "tutorial.md"
LOGS = ROOT / "tests" / "fixtures" / "pair"


COLOUR = "## From colour images to a map\n"
"""Title of the section with logs of its own."""


def blocks(language: str, *, colour: bool = False) -> list[str]:
    """The code blocks of one language, of the section on colour images or of the rest of the tutorial."""
    before, _, rest = PAGE.read_text(encoding="utf-8").partition(COLOUR)
    section, _, after = rest.partition("\n## ")
    text = section if colour else before + after
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


def run(line: str, folder: Path) -> str:
    """Standard output of one command of the tutorial."""
    program, *arguments = shlex.split(line)
    started = {"octoreplay": [sys.executable, "-m", "octoreplay"], "python": [sys.executable]}[program]
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src"), "MPLBACKEND": "Agg", "COLUMNS": "100"}
    done = subprocess.run(
        [*started, *arguments], cwd=folder, env=environment, capture_output=True, text=True, encoding="utf-8",
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, f"{line}\n{done.stdout}{done.stderr}"
    return done.stdout


def printed_lines(text: str) -> set[str]:
    """Lines of a command's output without the width of their columns."""
    return {" ".join(line.split()) for line in text.splitlines() if line.strip() and "──" not in line}


@long
def test_the_tutorial_works_as_printed(tmp_path: Path) -> None:
    for log in LOGS.glob("*.mcap"):
        shutil.copy(log, tmp_path)
    (script,) = blocks("python")
    (tmp_path / "picture.py").write_text(script, encoding="utf-8")
    commands = [line for block in blocks("sh") for line in block.splitlines()]
    assert len(commands) == 11
    output = "".join(run(line, tmp_path) for line in commands)
    for name in ("team.yaml", "result.mcap", "report.html", "map.ply", "map.png", "metrics.csv",
                 "figures/disagreement.png", "figures/packet_size.png", "gradient.mcap"):  # fmt: skip
        assert (tmp_path / name).stat().st_size > 0, name
    shown = set().union(*(printed_lines(block) for block in blocks("text")))
    assert shown <= printed_lines(output), sorted(shown - printed_lines(output))


@long
def test_the_section_on_colour_images_works_as_printed(tmp_path: Path) -> None:
    shutil.copy(ROOT / "docs" / "tools" / "village_network.py", tmp_path)
    commands = [line for block in blocks("sh", colour=True) for line in block.splitlines()]
    assert len(commands) == 8
    output = "".join(run(line, tmp_path) for line in commands)
    shown = set().union(*(printed_lines(block) for block in blocks("text", colour=True)))
    assert len(shown) == 12
    assert shown <= printed_lines(output), sorted(shown - printed_lines(output))
