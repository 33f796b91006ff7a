"""Metadata records of a result (docs/result-format.md): description of the run and its inputs, and its summary."""

from __future__ import annotations

import dataclasses
import itertools
import json
import os
from collections.abc import Mapping
from pathlib import Path

from octoreplay._version import __version__
from octoreplay.config.file_url import is_url
from octoreplay.config.resolved import ResolvedRun
from octoreplay.config.team_file import dump_team
from octoreplay.io.containers.fingerprint import Fingerprint
from octoreplay.records import TEAM
from octoreplay.run_metrics import RunSummary

FORMAT_VERSION = "3"
"""Version of the result format; it increases with each incompatible change."""
READABLE_VERSIONS = ("2", FORMAT_VERSION)
"""Versions of the result format that ``ResultReader`` reads."""


def description_of(config: ResolvedRun, inputs: Mapping[str, Fingerprint], folder: Path) -> dict[str, dict[str, str]]:
    """Return the records that describe a run, by name: format, configuration, classes and fingerprints of the inputs.

    ``inputs`` has the fingerprints by absolute path; paths become relative to ``folder``, that of the result.
    """
    robots = tuple(robot.with_paths_from(folder) for robot in config.robots)
    used = dataclasses.replace(config, robots=robots, sensor=config.effective_sensor)
    classes = [{"id": 0, "name": "free", "color": None}]
    classes += [{"id": c.class_id, "name": c.name, "color": list(c.color)} for c in config.classes.classes]
    return {
        "octoreplay": {
            "version": __version__,
            "format_version": FORMAT_VERSION,
            "frame": TEAM,
            "robots": json.dumps([robot.robot_id for robot in robots]),
            "resolution": repr(config.map.resolution),
            "prior": repr(config.map.prior(config.classes.num_classes)),
            "rule": config.consensus.rule,
        },
        "config": {"team_file": dump_team(used, with_defaults=True)},
        "classes": {"classes": json.dumps(classes)},
        "inputs": {
            path if is_url(path) else os.path.relpath(path, folder): json.dumps(
                {"size": entry.size, "method": entry.method, "fingerprint": entry.value}
            )
            for path, entry in inputs.items()
        },
    }


def difference(name: str, values: Mapping[str, str], earlier: Mapping[str, str]) -> str:
    """Return a phrase on the first difference between a record of a run and that of an earlier one."""
    key = next(key for key in [*values, *earlier] if values.get(key) != earlier.get(key))
    if name == "inputs":
        return f"the log '{key}' is not as it was; run with --restart to start from the beginning"
    now, then = (record.get(key, "").splitlines() for record in (values, earlier))
    lines = next(((a, b) for a, b in itertools.zip_longest(now, then, fillvalue="") if a != b), ("", ""))
    return (
        f"'{lines[0].strip()}' was '{lines[1].strip()}'; use the same settings, or run with --restart to start from the"
        " beginning"
    )


def summary_values(summary: RunSummary, config: ResolvedRun, folder: Path) -> dict[str, str]:
    """Return the summary of a run as a record, with numbers and lists as JSON.

    The wall time is left out, because it differs by run. Paths of inputs in sentences become relative to ``folder``.
    """
    summary = _with_relative_paths(summary, config, folder)
    values = {"complete": "true"}
    for item in dataclasses.fields(summary):
        if item.name in ("wall_seconds", "log_sent_bytes", "last", "links", "frame_counts", "joins"):
            continue
        value = getattr(summary, item.name)
        values[item.name] = value if isinstance(value, str) else json.dumps(value)
    if summary.joins:
        values["joins"] = json.dumps([dataclasses.asdict(join) for join in summary.joins])
    values["links"] = json.dumps([dataclasses.asdict(link) for link in summary.links])
    counts = {robot_id: dataclasses.asdict(count) for robot_id, count in summary.frame_counts.items()}
    values["frame_counts"] = json.dumps(counts)
    return values


def _with_relative_paths(summary: RunSummary, config: ResolvedRun, folder: Path) -> RunSummary:
    """Summary with the paths of inputs in its sentences relative to a folder."""
    paths = (path for robot in config.robots for path in robot.files if isinstance(path, Path))
    files = {str(path): os.path.relpath(path, folder) for path in paths}
    # Longest first, because a path may begin with another one.
    names = sorted((name for name in files if Path(name).is_absolute()), key=len, reverse=True)

    def relative(text: str) -> str:
        for name in names:
            text = text.replace(name, files[name])
        return text

    counts = {
        robot_id: dataclasses.replace(
            count,
            first_missing={cause: relative(text) for cause, text in count.first_missing.items()},
            truncated_files=[relative(text) for text in count.truncated_files],
        )
        for robot_id, count in summary.frame_counts.items()
    }
    return dataclasses.replace(summary, frame_counts=counts, warnings=tuple(map(relative, summary.warnings)))
