"""Damages small logs in thousands of ways and reads them, or makes maps of them, in processes that are held to limits.

    python fuzz_logs.py --cases 3000 --seed 1
    python fuzz_logs.py --to map --cases 4000 --seed 1

Reading must give messages and a sentence, or be refused with one; with ``--to map`` the committed logs of the tests go
the whole way, and also have messages that lie in a container that is whole: a map comes of it, or one sentence.
Whatever else happens is a failure: another error, a warning of numpy, a process that dies, more memory than the limit
(RLIMIT_AS), more time than the limit for one case. Prints what came of the cases of each log and ends with 1 where one
failed; ``--case "mcap zstd:17"`` does one case again.
"""

from __future__ import annotations

import argparse
import json
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from support.log_damage import CONTAINERS, damage_log, read_all

BATCH = 100
MEMORY_BYTES = 1 << 31
SECONDS_PER_CASE = 5


class OutOfTimeError(BaseException):
    """A case takes too long; nothing may catch it on the way."""


class Messages:
    """Small logs of every container, of which all messages are read."""

    names = tuple(CONTAINERS)
    results = ("read whole", "damaged", "refused", "failed")

    def prepare(self, name: str, folder: Path) -> None:
        """Write the good log."""
        (folder / "good").mkdir()
        self._good = CONTAINERS[name](folder / "good")

    def damage(self, _: str, folder: Path, rng: random.Random) -> tuple[Path, str]:
        """A damaged copy, and what was done to it."""
        path = folder / self._good.name
        if self._good.is_dir():
            shutil.rmtree(path, ignore_errors=True)
            shutil.copytree(self._good, path)
        else:
            shutil.copyfile(self._good, path)
        return path, damage_log(path, rng)

    def read(self, path: Path, _: int) -> tuple[str, int]:
        """Outcome of reading, and number of messages."""
        outcome = read_all(path)
        result = "refused" if outcome.refusal else "damaged" if outcome.damage else "read whole"
        return result, len(outcome.messages)


class Maps:
    """The committed logs, the whole way to a map; every fifth case is a run."""

    results = ("map", "empty map", "refused", "failed")

    def __init__(self) -> None:
        from support import hostile_logs

        self._logs = hostile_logs
        self.names = hostile_logs.LOGS

    def prepare(self, name: str, _: Path) -> None:
        """Load the kernels before time is taken."""
        for is_run in (False, True):
            for log in (name, "streams/cloud.mcap"):
                self._logs.map_of_log(self._logs.FIXTURES / log, is_run=is_run)

    def damage(self, name: str, folder: Path, rng: random.Random) -> tuple[Path, str]:
        """A hostile copy, and what was done to it."""
        return self._logs.write_hostile_log(name, folder, rng)

    def read(self, path: Path, case: int) -> tuple[str, int]:
        """Outcome, and number of frames in the maps."""
        outcome = self._logs.map_of_log(path, is_run=case % 5 == 0)
        result = "refused" if outcome.refusal else "map" if outcome.num_frames else "empty map"
        return result, outcome.num_frames


def run_batch(to: str, name: str, first: int, number: int, seed: int) -> None:
    """Read some damaged copies of one log; prints a line of JSON for each."""
    goal = GOALS[to]()
    with tempfile.TemporaryDirectory() as folder:
        goal.prepare(name, Path(folder))
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
        signal.signal(signal.SIGALRM, _out_of_time)
        warnings.simplefilter("error")
        for case in range(first, first + number):
            print(json.dumps(run_case(goal, name, case, Path(folder), seed)), flush=True)


def run_case(goal: Messages | Maps, name: str, case: int, folder: Path, seed: int) -> dict[str, object]:
    """Outcome of one damaged copy of a log."""
    path, what = goal.damage(name, folder, random.Random(f"{seed} {name} {case}"))
    start = time.perf_counter()
    signal.alarm(SECONDS_PER_CASE)
    try:
        result, number = goal.read(path, case)
    except BaseException:
        return {"result": "failed", "what": what, "error": traceback.format_exc()}
    finally:
        signal.alarm(0)
    return {"result": result, "what": what, "number": number, "seconds": time.perf_counter() - start}


def _out_of_time(*_: object) -> None:
    raise OutOfTimeError(f"not read within {SECONDS_PER_CASE} s")


GOALS: dict[str, Callable[[], Messages | Maps]] = {"messages": Messages, "map": Maps}


def parent(to: str, cases: int, seed: int) -> int:
    """Spread the cases over the logs and print what came of them; returns how many failed."""
    goal = GOALS[to]()
    each = -(-cases // len(goal.names))
    total: Counter[str] = Counter()
    titles = "".join(f"{result:>11}" for result in goal.results)
    print(f"{'log':38}{titles} {'kept':>6} {'slowest':>8}")
    for name in goal.names:
        rows: list[dict[str, object]] = []
        for first in range(0, each, BATCH):
            rows += _batch(to, name, first, min(BATCH, each - first), seed)
        counts = Counter(str(row["result"]) for row in rows)
        kept = sum(int(str(row.get("number", 0))) for row in rows) / max(1, len(rows))
        slowest = max(float(str(row.get("seconds", 0.0))) for row in rows)
        numbers = "".join(f"{counts[result]:11}" for result in goal.results)
        print(f"{name:38}{numbers} {kept:6.1f} {slowest * 1e3:5.0f} ms", flush=True)
        for row in rows:
            if row["result"] == "failed":
                print(f"  {row['case']}: {row.get('what')}\n{row.get('error')}", file=sys.stderr)
        total += counts
    print(f"{'all':38}{''.join(f'{total[result]:11}' for result in goal.results)}")
    return total["failed"]


def _batch(to: str, name: str, first: int, number: int, seed: int) -> list[dict[str, object]]:
    """The rows of some cases from a process of their own; a case at which it died has failed."""
    command = [
        sys.executable, __file__, "--to", to, "--seed", str(seed), "--batch", name, str(first), str(number),
    ]  # fmt: skip
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=60 + SECONDS_PER_CASE * number, check=False
        )
        output, error = done.stdout, done.stderr
    except subprocess.TimeoutExpired as expired:
        output, error = (expired.stdout or b"").decode(), "the process did not end"
    rows = [json.loads(line) for line in output.splitlines()]
    for index, row in enumerate(rows):
        row["case"] = f"{name}:{first + index}"
    if len(rows) < number:
        rows.append({"result": "failed", "case": f"{name}:{first + len(rows)}", "error": error})
        rest = number - len(rows)
        rows += _batch(to, name, first + len(rows), rest, seed) if rest else []
    return rows


def main() -> int:
    """Read the options and run what they ask for."""
    parser = argparse.ArgumentParser(description="Read logs that were damaged in thousands of ways.")
    parser.add_argument("--to", choices=sorted(GOALS), default="messages", help="how far a damaged log goes")
    parser.add_argument("--cases", type=int, default=3000, help="how many, over all logs")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--case", help="one case again, as it was printed: LOG:NUMBER")
    parser.add_argument("--batch", nargs=3, metavar=("LOG", "FIRST", "NUMBER"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.case:
        name, _, number = options.case.rpartition(":")
        run_batch(options.to, name, int(number), 1, options.seed)
        return 0
    if options.batch:
        name, first, number = options.batch
        run_batch(options.to, name, int(first), int(number), options.seed)
        return 0
    return int(parent(options.to, options.cases, options.seed) > 0)


if __name__ == "__main__":
    sys.exit(main())
