"""Measurement and reports of all benchmarks: interleaved rounds, medians with their spread, targets, JSON."""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import statistics
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Row:
    """One measured figure: the median over the rounds, their range, and what it is to reach."""

    what: str
    value: float
    unit: str
    low: float | None = None
    high: float | None = None
    must: float | None = None
    goal: float | None = None
    more_is_better: bool = False
    note: str = ""

    @property
    def verdict(self) -> str:
        """Verdict on the target; empty without one."""
        if self.must is None:
            return ""
        if self.goal is not None and self._reaches(self.goal):
            return "goal reached"
        return "reached" if self._reaches(self.must) else "MISSED"

    @property
    def target(self) -> str:
        """The target in words; empty without one."""
        if self.must is None:
            return ""
        sign = ">=" if self.more_is_better else "<="
        return f"{sign} {self.must:g}" + ("" if self.goal is None else f" (goal {self.goal:g})")

    @property
    def shown(self) -> str:
        """The figure with its spread."""
        spread = "" if self.low is None or self.high is None else f" ({_number(self.low)} - {_number(self.high)})"
        return f"{_number(self.value)} {self.unit}{spread}"

    def _reaches(self, bound: float) -> bool:
        return self.value >= bound if self.more_is_better else self.value <= bound


@dataclass
class Report:
    """The rows of one benchmark, printed as they come and stored at the end."""

    benchmark: str
    options: Mapping[str, Any] = field(default_factory=dict)
    rows: list[Row] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)

    def add(self, row: Row) -> None:
        """Take a row and print it."""
        self.rows.append(row)
        target = f"  {row.target}: {row.verdict}" if row.must is not None else ""
        print(f"{row.what:<58} {row.shown}{target}{'  ' + row.note if row.note else ''}", file=sys.stderr, flush=True)

    def remark(self, sentence: str) -> None:
        """Take a sentence and print it."""
        self.remarks.append(sentence)
        print(sentence, file=sys.stderr, flush=True)

    def save(self, target: str | None) -> None:
        """Write the report as JSON to a file, or to standard output for '-'."""
        if target is None:
            return
        rows = [{**asdict(row), "verdict": row.verdict} for row in self.rows]
        content = {
            "benchmark": self.benchmark, "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
            "machine": machine(),
            # Where the report goes says nothing of what was measured.
            "options": {name: str(value) for name, value in self.options.items() if name != "json"},
            "remarks": self.remarks, "rows": rows,
        }  # fmt: skip
        text = json.dumps(content, indent=1) + "\n"
        if target == "-":
            sys.stdout.write(text)
        else:
            Path(target).write_text(text, encoding="utf-8")


def arguments(description: str, *, rounds: int, add: Callable[[argparse.ArgumentParser], None] | None = None) -> Any:
    """The command line of a benchmark: ``--json``, ``--rounds`` and its own options."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--json", metavar="FILE", help="write the results as JSON; - for standard output")
    parser.add_argument("--rounds", type=int, default=rounds, help="measured rounds (default: %(default)s)")
    if add is not None:
        add(parser)
    return parser.parse_args()


def interleave(contenders: Mapping[str, Callable[[], float]], rounds: int) -> dict[str, list[float]]:
    """Results of each contender in each round; a round runs all contenders one after another."""
    values: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(rounds):
        for name, run in contenders.items():
            values[name].append(run())
    return values


def measured(what: str, values: Sequence[float], unit: str, **targets: Any) -> Row:
    """The row of one contender: median and range."""
    return Row(what, statistics.median(values), unit, min(values), max(values), **targets)


def speedup(what: str, ours: Sequence[float], theirs: Sequence[float], **targets: Any) -> Row:
    """Ratio of the peer's time to ours, round by round."""
    ratios = [b / a for a, b in zip(ours, theirs, strict=True)]
    return Row(
        what, statistics.median(ratios), "times as fast", min(ratios), max(ratios), more_is_better=True, **targets
    )


@contextmanager
def pinned() -> Iterator[None]:
    """This process and the ones that it starts on one core, where the system can do that."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(before)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def machine() -> dict[str, str]:
    """Machine and package versions of the measurement."""
    cpu = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        lines = info.read_text().splitlines()
        cpu = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), cpu)
    names = ("octoreplay", "numpy", "numba", "pyoctomap", "open3d-cpu")
    packages = ", ".join(f"{name} {_version(name)}" for name in names)
    return {
        "cpu": cpu,
        "cores": str(os.cpu_count()),
        "system": platform.platform(),
        "python": platform.python_version(),
        "packages": packages,
        "load": " ".join(f"{load:.2f}" for load in os.getloadavg()),
    }


def _version(package: str) -> str:
    try:
        return version(package)
    except ImportError:
        return "missing"


def _number(value: float) -> str:
    """Three digits, without an exponent."""
    if value == 0 or abs(value) >= 100:
        return f"{value:,.0f}"
    return f"{value:.3g}"
