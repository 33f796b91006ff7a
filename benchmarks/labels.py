"""Maps with the labels of a network against maps with true labels: ``python benchmarks/labels.py FOLDER -o RESULT.md``.

A network is fitted to two villages (docs/tools/village_network.py) and labels the logs of teams in other villages. Each
team is recorded with colour images that are aligned to depth, and by a colour camera 0.3 m beside the depth camera.

A second table has the labels that points of a lidar with 16 rings take over from a perfectly labelled image, at the
poses of the first robot: the share of points in the image that the camera does not see, and of right labels with and
without the search for hidden points.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader

from octoreplay.io.messages.ros_types import typestore
from octoreplay.io.messages.sensor_messages import Calibration
from octoreplay.labelling.projection import ImageProjection, depth_points
from octoreplay.records import CameraModel
from octoreplay.simulate.body_poses import T_BODY_CAMERA, body_poses
from octoreplay.simulate.camera import MeshCamera
from octoreplay.simulate.exploration import explore
from octoreplay.simulate.village import make_village

ROOT = Path(__file__).parents[1]
TRAINING = (100, 101)
CAMERAS = {"aligned": "0,0,0", "0.3 m beside": "0.3,0,0"}
NO_LABEL = 255


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    arguments = parser.parse_args()
    folder = arguments.folder
    for seed in TRAINING:
        simulate(folder / f"training_{seed}", seed, rate=1, colour="raw")
    teams = [folder / f"training_{seed}" for seed in TRAINING]
    network = folder / "village.onnx"
    script = ROOT / "docs" / "tools" / "village_network.py"
    subprocess.run([sys.executable, script, *teams, "-o", network], check=True)
    lines = [
        "| seed | colour camera | pixels with a label | right label | mean IoU, network | mean IoU, true labels |",
        "|---|---|---|---|---|---|",
    ]
    for seed in arguments.seeds:
        for name, offset in CAMERAS.items():
            team = folder / f"team_{seed}_{offset.replace(',', '_')}"
            simulate(team, seed, rate=2, colour="jpeg", colour_offset=offset)
            labelled = [label(log, network, team / "team.yaml") for log in sorted(team.glob("husky_?.mcap"))]
            share, accuracy = pixel_scores(sorted(team.glob("husky_?.mcap")), labelled)
            iou = [mean_iou(team, inputs) for inputs in (labelled, [team / "team.yaml"])]
            lines.append(
                f"| {seed} | {name} | {100 * share:.1f} % | {100 * accuracy:.1f} % | {iou[0]:.3f} | {iou[1]:.3f} |"
            )
            print(lines[-1], flush=True)
    heads = ("seed", "hidden points", "right label, all points", "right label, visible points", "visible points lost")
    lines += ["", f"| {' | '.join(heads)} |", "|" + "---|" * len(heads)]
    for seed in arguments.seeds:
        lines.append(lidar_row(seed))
        print(lines[-1], flush=True)
    arguments.output.write_text("\n".join(lines) + "\n", encoding="utf-8")


def octoreplay(*arguments: object) -> Any:
    """Run a command and return its JSON document."""
    words = [sys.executable, "-m", "octoreplay", *map(str, arguments), "--json"]
    return json.loads(subprocess.run(words, check=True, capture_output=True, text=True).stdout)


def simulate(folder: Path, seed: int, **options: object) -> None:
    """Simulate three robots over 40 s with true labels."""
    words = [word for name, value in options.items() for word in (f"--{name.replace('_', '-')}", value)]
    octoreplay("simulate", folder, "--robots", 3, "--duration", 40, "--seed", seed, "--label-noise", 0, *words)


def label(log: Path, network: Path, classes: Path) -> Path:
    """Label a log; return the labelled one."""
    output = log.with_suffix(".labelled.mcap")
    octoreplay("label", log, "--model", network, "--classes", classes, "--label-offset", 1, "-o", output)
    return output


def mean_iou(team: Path, inputs: list[Path]) -> float:
    """Mean IoU over the known cells of the map of all evidence, after the run."""
    octoreplay("run", *inputs, "--resolution", 0.3, "-o", team / "result.mcap", "--force")
    found = octoreplay("evaluate", team / "result.mcap", "--truth", team / "world.npz")
    maps = {entry["robot_id"]: entry for entry in found["ticks"][-1]["maps"]}
    return float(maps["central"]["mean_iou_known"])


def pixel_scores(logs: list[Path], labelled: list[Path]) -> tuple[float, float]:
    """Share of the measured pixels that have a label, and of these the share with the right one."""
    true, found = (np.concatenate([label_images(path) for path in paths]) for paths in (logs, labelled))
    is_measured = true != NO_LABEL
    has_label = is_measured & (found != NO_LABEL)
    return has_label.sum() / is_measured.sum(), (found == true)[has_label].mean()


def lidar_row(seed: int) -> str:
    """Row of the second table: a lidar 0.3 m above and 0.2 m behind a camera of 640x480 pixels."""
    world = make_village(70.0, seed)
    drive = explore(world, 1, 401, 0.1)
    lidar_model = CameraModel(1200, 800, 600, 600, 599.5, 399.5)
    lidar, colour = (MeshCamera(world, m) for m in (lidar_model, CameraModel(640, 480, 520, 520, 319.5, 239.5)))
    K = np.array([[520, 0, 319.5], [0, 520, 239.5], [0, 0, 1]], float)
    calibration = Calibration(0, "", 640, 480, "plumb_bob", np.zeros(0), K, np.zeros((3, 4)))
    projection = ImageProjection(calibration, "camera", is_rectified=True)
    # Rings every 2 degrees, points every two pixels (0.2 degrees).
    rows = np.rint(399.5 + 600 * np.tan(np.radians(np.arange(-15, 16, 2)))).astype(int)
    T_colour_lidar = np.eye(4)
    T_colour_lidar[:3, 3] = 0.0, -0.3, -0.2
    totals = np.zeros(6)
    for pose in body_poses(world.terrain, drive.states[0][::10]):
        T_world_lidar = pose @ T_BODY_CAMERA
        depth, labels = lidar.take(T_world_lidar, 60.0)
        sparse = np.zeros_like(depth)
        sparse[np.ix_(rows, np.arange(0, 1200, 2))] = 1.0
        chosen = np.flatnonzero((sparse * depth).ravel())
        points, point_labels = depth_points(depth, lidar_model)[chosen], labels.ravel()[chosen]
        pixels, is_seen = projection.visible_pixels(points, T_colour_lidar)
        in_camera = points + T_colour_lidar[:3, 3]
        is_inside = projection.pixels(in_camera)[1]
        image_depth, image_labels = colour.take(T_world_lidar @ np.linalg.inv(T_colour_lidar), 1000.0)
        there = pixels[:, 1], pixels[:, 0]
        is_hidden = is_inside & (image_depth[there] > 0) & (in_camera[:, 2] > 1.02 * image_depth[there] + 0.05)
        is_right = image_labels[there] == point_labels
        totals += [
            is_inside.sum(), is_hidden.sum(), (is_inside & is_right).sum(), is_seen.sum(), (is_seen & is_right).sum(),
            (is_inside & ~is_hidden & ~is_seen).sum(),
        ]  # fmt: skip
    inside, hidden, right, seen, right_seen, lost = totals
    shares = (hidden / inside, right / inside, right_seen / seen, lost / (inside - hidden))
    return f"| {seed} | " + " | ".join(f"{100 * share:.1f} %" for share in shares) + " |"


def label_images(path: Path) -> np.ndarray:
    """Label images (N, H, W) of a log."""
    images = []
    with path.open("rb") as file:
        for schema, channel, stored in make_reader(file).iter_messages():
            if channel.topic.endswith(("/labels/image_raw", "/labels")):
                image = typestore().deserialize_cdr(stored.data, schema.name)
                images.append(np.asarray(image.data).reshape(image.height, image.width))
    return np.array(images)


if __name__ == "__main__":
    main()
