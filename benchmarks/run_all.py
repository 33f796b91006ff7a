"""Runs all benchmarks and writes ``results/<date>.json`` and the same as a Markdown table, ``results/<date>.md``."""

from __future__ import annotations

import argparse
import datetime
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from rounds import Row

HERE = Path(__file__).parent
FULL: dict[str, list[str]] = {
    "insertion": [], "consensus": [], "replay": [], "memory": [], "cold_start": [], "roofline": [],
    "packets": [], "reading": [],
}  # fmt: skip
QUICK: dict[str, list[str]] = {
    "insertion": ["--frames", "10", "--rounds", "2"],
    "consensus": ["--rounds", "2", "--rest", "8"],
    "replay": ["--duration", "5", "--rounds", "1"],
    "memory": ["--frames", "20"],
    "cold_start": ["--rounds", "2", "--compilations", "1"],
    "roofline": ["--frames", "20", "--rounds", "2"],
    "packets": ["--duration", "20", "--only", "delta", "--only", "ring"],
    "reading": ["--seconds", "5", "--gigabytes", "0.5", "--part-gigabytes", "0.3", "--rounds", "2"],
}


def main() -> None:
    """Run them one after another; one that fails is named and the others go on."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a few minutes, for a look; not for the record")
    parser.add_argument("--only", action="append", choices=tuple(FULL), help="run only these")
    parser.add_argument("--folder", type=Path, help="a 7-Scenes sequence, for insertion's real frames")
    options = parser.parse_args()
    reports = []
    for name, extra in (QUICK if options.quick else FULL).items():
        if options.only is None or name in options.only:
            reports += _run(name, extra)
            if name == "insertion" and options.folder is not None:
                reports += _run(name, [*extra, "--scene", "seven-scenes", "--folder", str(options.folder)])
    date = datetime.datetime.now(datetime.UTC).date().isoformat()
    results = HERE / "results"
    results.mkdir(exist_ok=True)
    stem = f"{date}-quick" if options.quick else date
    (results / f"{stem}.json").write_text(json.dumps(reports, indent=1) + "\n", encoding="utf-8")
    (results / f"{stem}.md").write_text(_markdown(reports), encoding="utf-8")
    print(f"wrote {results / stem}.json and .md")


def _run(name: str, extra: list[str]) -> list[dict[str, Any]]:
    """One benchmark's report; none when it failed."""
    print(f"\n== {name} {' '.join(extra)}", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "report.json"
        done = subprocess.run([sys.executable, str(HERE / f"{name}.py"), "--json", str(target), *extra], check=False)
        if done.returncode != 0:
            print(f"{name} failed")
            return []
        report: dict[str, Any] = json.loads(target.read_text(encoding="utf-8"))
        return [report]


def _markdown(reports: list[dict[str, Any]]) -> str:
    """The machine, the rows that have a target, then all rows of each benchmark."""
    if not reports:
        return ""
    machine = reports[0]["machine"]
    lines = [", ".join(f"{name}: {machine[name]}" for name in ("cpu", "cores", "system", "python", "packages"))]
    tables = [(report["benchmark"], [_row(entry) for entry in report["rows"]], report["remarks"]) for report in reports]
    targets = [(name, row) for name, rows, _ in tables for row in rows if row.must is not None]
    lines += ["", "| benchmark | what | measured | target | |", "|---|---|---|---|---|"]
    lines += [f"| {name} | {row.what} | {row.shown} | {row.target} | {row.verdict} |" for name, row in targets]
    for name, rows, remarks in tables:
        lines += ["", f"### {name}", "", "| what | measured | |", "|---|---|---|"]
        lines += [f"| {row.what} | {row.shown} | {row.note} |" for row in rows]
        lines += ["", *(f"{sentence}." for sentence in remarks)]
    return "\n".join(lines).rstrip() + "\n"


def _row(entry: dict[str, Any]) -> Row:
    """A stored row."""
    return Row(**{name: value for name, value in entry.items() if name != "verdict"})


if __name__ == "__main__":
    main()
