"""octoreplay: replay of multi-robot logs into semantic octree maps with distributed consensus.

Only the names in ``__all__`` are public; everything else may change between versions. They are imported at their first
use, so that ``import octoreplay`` and ``octoreplay --help`` are fast.
"""

from __future__ import annotations

import importlib

from octoreplay._version import __version__

# As in typing, whose import takes longer than all else here; the command line sets its signal handlers after it.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

    from octoreplay.config.frames_file import load_frames_file
    from octoreplay.config.paths_file import load_paths_file
    from octoreplay.config.robot import RobotConfig
    from octoreplay.config.run import RunConfig
    from octoreplay.config.team_file import load_team_file
    from octoreplay.data_table import Table
    from octoreplay.errors import ConfigError, InputError, MemoryLimitError, OctoreplayError, OutputError, PacketError
    from octoreplay.evaluate.checks import CheckRow, check_result
    from octoreplay.evaluate.comparison import ResultComparison, compare_results
    from octoreplay.evaluate.evaluation import evaluate_result
    from octoreplay.evaluate.records import Evaluation
    from octoreplay.io.containers.logs import open_log
    from octoreplay.io.datasets.cloud_folder import CloudImportSummary, import_clouds
    from octoreplay.io.datasets.rgbd_folder import ImportSummary, import_rgbd
    from octoreplay.io.robots.discover import discover, resolve
    from octoreplay.records import ClassTable, LeafTable, SemanticClass
    from octoreplay.replay.alignment import Alignment, RobotFrame, align_logs, aligned_config
    from octoreplay.replay.run import Progress, replay_team
    from octoreplay.report.export import export_map
    from octoreplay.result import Result, open_result
    from octoreplay.run_metrics import RunSummary, TickMetrics
    from octoreplay.simulate.settings import SimulationConfig
    from octoreplay.simulate.team import simulate_team
    from octoreplay.stored_map import PointQuery, StoredMap
    from octoreplay.study.sweep import Sweep, SweepProgress, run_sweep
    from octoreplay.study.tiles.run import replay_tiles

_MODULES = {
    "Alignment": "replay.alignment",
    "CheckRow": "evaluate.checks",
    "ClassTable": "records",
    "CloudImportSummary": "io.datasets.cloud_folder",
    "ConfigError": "errors",
    "Evaluation": "evaluate.records",
    "ImportSummary": "io.datasets.rgbd_folder",
    "InputError": "errors",
    "LeafTable": "records",
    "MemoryLimitError": "errors",
    "OctoreplayError": "errors",
    "OutputError": "errors",
    "PacketError": "errors",
    "PointQuery": "stored_map",
    "Progress": "replay.run",
    "Result": "result",
    "ResultComparison": "evaluate.comparison",
    "RobotConfig": "config.robot",
    "RobotFrame": "replay.alignment",
    "RunConfig": "config.run",
    "RunSummary": "run_metrics",
    "SemanticClass": "records",
    "SimulationConfig": "simulate.settings",
    "StoredMap": "stored_map",
    "Sweep": "study.sweep",
    "SweepProgress": "study.sweep",
    "Table": "data_table",
    "TickMetrics": "run_metrics",
    "align_logs": "replay.alignment",
    "aligned_config": "replay.alignment",
    "check_result": "evaluate.checks",
    "compare_results": "evaluate.comparison",
    "discover": "io.robots.discover",
    "evaluate_result": "evaluate.evaluation",
    "export_map": "report.export",
    "import_clouds": "io.datasets.cloud_folder",
    "import_rgbd": "io.datasets.rgbd_folder",
    "load_frames_file": "config.frames_file",
    "load_paths_file": "config.paths_file",
    "load_team_file": "config.team_file",
    "open_log": "io.containers.logs",
    "open_result": "result",
    "replay_team": "replay.run",
    "replay_tiles": "study.tiles.run",
    "resolve": "io.robots.discover",
    "run_sweep": "study.sweep",
    "simulate_team": "simulate.team",
}
"""Module of each public name."""

__all__ = [
    "Alignment", "CheckRow", "ClassTable", "CloudImportSummary", "ConfigError", "Evaluation", "ImportSummary",
    "InputError", "LeafTable", "MemoryLimitError", "OctoreplayError", "OutputError", "PacketError", "PointQuery",
    "Progress", "Result", "ResultComparison", "RobotConfig", "RobotFrame", "RunConfig", "RunSummary", "SemanticClass",
    "SimulationConfig", "StoredMap", "Sweep", "SweepProgress", "Table", "TickMetrics", "__version__", "align_logs",
    "aligned_config", "check_result", "compare_results", "discover", "evaluate_result", "export_map", "import_clouds",
    "import_rgbd", "load_frames_file", "load_paths_file", "load_team_file", "open_log", "open_result", "replay_team",
    "replay_tiles", "resolve", "run_sweep", "simulate_team",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """Import a public name at its first use."""
    module = _MODULES.get(name)
    if module is None:
        raise AttributeError(f"module 'octoreplay' has no attribute '{name}'")
    value = getattr(importlib.import_module(f"octoreplay.{module}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return the public names; the module's other names are not part of the API."""
    return sorted(__all__)
