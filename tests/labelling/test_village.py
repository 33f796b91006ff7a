"""From colour images to a scored map: a network that is fitted to one village labels the log of another."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import numpy as np
import onnx
import pytest

from octoreplay.simulate.settings import SimulationConfig
from octoreplay.simulate.team import simulate_team
from support.command_line import octoreplay
from support.long_suite import long
from support.stored_messages import pixels, read_messages

SCRIPT = Path(__file__).parents[2] / "docs" / "tools" / "village_network.py"
DEPTH = "/husky_1/camera/depth/image_raw"


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A folder with a fitted network, and teams whose colour camera is aligned and beside the depth camera."""
    folder = tmp_path_factory.mktemp("village")
    common = {"num_robots": 1, "label_noise": 0.0, "world_size": 40.0, "resolution": 0.4}
    simulate_team(folder / "training", SimulationConfig(seed=100, duration=60.0, rate=0.5, colour="raw", **common))
    for name, offset in (("aligned", 0.0), ("beside", 0.3)):
        config = SimulationConfig(
            seed=1, duration=20.0, rate=2.0, colour="jpeg", colour_offset=(offset, 0.0, 0.0), **common
        )
        simulate_team(folder / name, config)
    spec = importlib.util.spec_from_file_location("village_network", SCRIPT)
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    onnx.save(script.fitted(*script.team_images([folder / "training"])), folder / "village.onnx")
    return folder


def result(*arguments: object) -> dict:
    """The JSON document of a command."""
    done = octoreplay(*arguments, "--json", "-q")
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def mean_iou(team: Path, log: Path) -> float:
    """Mean IoU over the known cells of the map of a log."""
    output = team / f"{log.stem}.result.mcap"
    result("run", log, "--resolution", 0.4, "-o", output)
    ticks = result("evaluate", output, "--truth", team / "world.npz")["ticks"]
    return next(entry["mean_iou_known"] for entry in ticks[-1]["maps"] if entry["robot_id"] == "central")


@long
@pytest.mark.parametrize(("name", "least_labelled"), [("aligned", 1.0), ("beside", 0.85)])
def test_the_map_of_a_networks_labels_is_compared_with_that_of_true_labels(
    folder: Path, name: str, least_labelled: float
) -> None:
    log, labelled = folder / name / "husky_1.mcap", folder / name / "husky_1.labelled.mcap"
    result(
        "label", log, "--model", folder / "village.onnx", "--classes", folder / name / "team.yaml",
        "--label-offset", 1, "-o", labelled,
    )  # fmt: skip
    true = np.array([pixels(m) for _, m in read_messages(log)["/husky_1/camera/labels/image_raw"]])
    found = np.array([pixels(m) for _, m in read_messages(labelled)[f"{DEPTH}/labels"]])
    has_label = (true != 255) & (found != 255)
    assert has_label.sum() >= least_labelled * (true != 255).sum()
    assert (found == true)[has_label].mean() > 0.94
    # Thin trunks and fences lose most: the ratio is 0.74 here and 0.84 to 0.88 in larger villages (docs/labels.md).
    assert mean_iou(folder / name, labelled) > 0.65 * mean_iou(folder / name, log)
