"""Alignment of simulated robots' maps: recall, false accepts, accuracy and time, under many conditions.

Each robot of a village is mapped in a random frame: any yaw, up to 30 m, tilted by up to a degree. Pairs of one village
have a true pose, pairs of different villages have none. A pose off by more than 1 m or 5 degrees is wrong; with drift
it is 3 m and 10 degrees, because each map is bent. Weights and limits were fitted on the seeds 1 - 6, 11 - 16, 300 -
305, 400, 401, 2000 - 2004, 3000 - 3007 and 4000 - 4009.
"""

from __future__ import annotations

import argparse
import itertools
import math
import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rounds import Report, Row, arguments
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from octoreplay.config.frames_file import load_frames_file
from octoreplay.config.run import RunConfig
from octoreplay.config.sensor import MapConfig, SensorConfig
from octoreplay.config.subteam import subteam
from octoreplay.config.team_file import load_team_file
from octoreplay.evaluate.evaluation import evaluate_result
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.mapping.sensor import ScanCaster, add_scan, clamped_increments
from octoreplay.records import (
    CENTRAL,
    CameraModel,
    CloudFrame,
    DepthFrame,
    Float32Array,
    Float64Array,
    Frame,
    UInt8Array,
)
from octoreplay.registration.measured_points import MeasuredPoints
from octoreplay.registration.own_map import OwnMap
from octoreplay.registration.pairs import PairAlignment
from octoreplay.registration.team import align_team
from octoreplay.replay.alignment import align_logs
from octoreplay.replay.run import replay_team
from octoreplay.simulate.body_poses import T_BODY_CAMERA, body_poses
from octoreplay.simulate.camera import LabelPatches, MeshCamera, add_depth_noise, add_label_noise
from octoreplay.simulate.exploration import explore
from octoreplay.simulate.odometry import drift_corrections
from octoreplay.simulate.scene import NO_LABEL
from octoreplay.simulate.settings import SimulationConfig
from octoreplay.simulate.team import simulate_team
from octoreplay.simulate.village import make_village
from octoreplay.simulate.world import World
from octoreplay.transforms import inverse, numbers_of, transform_of

CAMERA = CameraModel(160, 120, 65.25, 65.25, 79.5, 59.5)
RATE = 4.0
MAX_DEPTH, MAX_RANGE = 20.0, 10.0
NUM_CLASSES = 8
ROBOT_BOX = np.array([[-0.5, -0.35, -0.13], [0.5, 0.35, 0.77]])
LIDAR_RINGS, LIDAR_COLUMNS = 32, 600
LIDAR_HEIGHT = 0.9
LIDAR_RANGE = 20.0


@dataclass(frozen=True)
class Condition:
    """Condition under which a team is mapped."""

    name: str
    label_noise: float = 0.1
    patchy_noise: float = 0.0
    is_confused: bool = False
    sees_robots: bool = False
    has_lidar: bool = False
    is_labelled: bool = True
    resolution: float = 0.3
    drift: tuple[float, float] = (0.0, 0.0)
    identical_houses: bool = False
    wrong_shift: float = 1.0
    wrong_angle: float = 5.0


PLAIN = Condition("10 % label noise")
CONDITIONS = (
    PLAIN,
    replace(PLAIN, name="no label noise", label_noise=0.0),
    replace(PLAIN, name="40 % label noise", label_noise=0.4),
    replace(PLAIN, name="patchy label noise, 10 % of the places", patchy_noise=0.1),
    replace(PLAIN, name="two networks that confuse different classes", is_confused=True),
    replace(PLAIN, name="moving robots in view", sees_robots=True),
    replace(PLAIN, name="cells of 0.2 m", resolution=0.2),
    replace(PLAIN, name="cells of 0.5 m", resolution=0.5),
    replace(PLAIN, name="every second robot with a LiDAR", has_lidar=True),
    replace(PLAIN, name="drift of 1 % and 0.5 degrees per 10 m", drift=(1.0, 0.5), wrong_shift=3.0, wrong_angle=10.0),
    replace(PLAIN, name="identical houses", identical_houses=True),
    replace(PLAIN, name="without labels", is_labelled=False),
)


@dataclass(frozen=True, eq=False)
class OwnFrame:
    """Map of a robot in its own frame, and the frame's true pose in the village."""

    own: OwnMap
    T_village_own: Float64Array


@dataclass(frozen=True)
class Outcome:
    """Alignment of one pair: verdict, errors against the truth [m, degree] (None: none), overlap, seconds, L."""

    is_accepted: bool
    refusal: str
    shift: float | None
    angle: float | None
    overlap: float
    seconds: float
    score: float

    def is_right(self, condition: Condition) -> bool:
        """True where the pose is the true one."""
        if self.shift is None or self.angle is None:
            return False
        return self.shift < condition.wrong_shift and self.angle < condition.wrong_angle


def main() -> None:
    """Align all pairs of robots of fresh villages and of different villages."""
    options = arguments(__doc__ or "", rounds=1, add=_add_options)
    report = Report("frames", vars(options))
    chosen = [c for c in CONDITIONS if options.condition is None or options.condition in c.name]
    with ProcessPoolExecutor(options.processes) as pool:
        for condition in chosen:
            num = options.villages if condition is PLAIN else options.other_villages
            seeds = range(options.heldout_seed, options.heldout_seed + num)
            teams = list(pool.map(make_team, seeds, itertools.repeat(condition), itertools.repeat(options.robots)))
            _report_within(report, condition, list(pool.map(_within, *zip(*_pairs_within(teams), strict=True))))
            across = list(_pairs_across(teams))[
                : options.cross_pairs if condition is PLAIN else options.cross_pairs // 10
            ]
            if across:
                _report_across(report, condition, list(pool.map(_across, *zip(*across, strict=True), chunksize=10)))
    if options.large_team:
        _report_large_team(report, options.heldout_seed)
    if options.iou_teams:
        _report_iou(report, range(options.heldout_seed, options.heldout_seed + options.iou_teams))
    report.save(options.json)


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--heldout-seed", type=int, default=1000, help="seed of the first village (default: %(default)s)"
    )
    parser.add_argument(
        "--villages", type=int, default=8, help="villages of the plain condition (default: %(default)s)"
    )
    parser.add_argument("--other-villages", type=int, default=2, help="villages of the others (default: %(default)s)")
    parser.add_argument("--robots", type=int, default=5, help="robots in a village (default: %(default)s)")
    parser.add_argument(
        "--cross-pairs", type=int, default=400, help="pairs of different villages (default: %(default)s)"
    )
    parser.add_argument("--condition", help="only the conditions whose names contain this")
    parser.add_argument("--processes", type=int, default=2, help="worker processes (default: %(default)s)")
    parser.add_argument("--large-team", action="store_true", help="align 16 robots too")
    parser.add_argument(
        "--iou-teams", type=int, default=0,
        help="teams of 4 robots whose maps are compared with the true village (default: %(default)s)",
    )  # fmt: skip


def make_team(seed: int, condition: Condition, num_robots: int, world_size: float = 70.0) -> list[OwnFrame]:
    """Maps of a village's robots, each in a random frame of its own."""
    world = make_village(world_size, seed, identical_houses=condition.identical_houses)
    period = 1.0 / RATE
    drive = explore(world, num_robots, round(60 * RATE), period)
    poses = np.array([body_poses(world.terrain, states) for states in drive.states])
    camera = MeshCamera(world, CAMERA)
    team = []
    for index in range(num_robots):
        rng = np.random.default_rng([seed, index])
        sensor = SensorConfig(max_range=MAX_RANGE)
        frames: Iterator[Frame] = _camera_frames(camera, poses, index, condition, rng)
        if condition.has_lidar and index % 2:
            sensor = SensorConfig(max_range=LIDAR_RANGE)
            frames = _lidar_frames(Lidar(world, CAMERA), poses, index, condition, rng)
        drift = drift_corrections(poses[index], *condition.drift, rng)
        team.append(_map(frames, drift, sensor, condition, rng))
    return team


class Lidar(MeshCamera):
    """Rotating scanner with the interface of the camera: depths are ranges."""

    def __init__(self, world: World, camera: CameraModel) -> None:
        super().__init__(world, camera)
        up, around = np.meshgrid(
            np.radians(np.linspace(-25, 15, LIDAR_RINGS)), np.arange(LIDAR_COLUMNS) * (2 * math.pi / LIDAR_COLUMNS),
            indexing="ij",
        )  # fmt: skip
        self._rays = np.stack([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)], axis=-1)


def _camera_frames(
    camera: MeshCamera, poses: Float64Array, index: int, condition: Condition, rng: np.random.Generator
) -> Iterator[DepthFrame]:
    """Images of one robot with the noise of its sensors; poses are those in the village."""
    patches = LabelPatches(condition.patchy_noise, NUM_CLASSES, rng)
    for step in range(poses.shape[1]):
        T = poses[index, step] @ T_BODY_CAMERA
        depth, labels = camera.take(T, MAX_DEPTH)
        if condition.sees_robots:
            others = np.delete(poses[:, step], index, axis=0)
            depth, labels = _with_robots(camera, depth, labels, T, others)
        labels = _noisy(labels, camera.points(depth, T), condition, patches, index, rng)
        depth = add_depth_noise(depth, rng)
        classes = np.where(labels == NO_LABEL, 0, labels).astype(np.uint8) if condition.is_labelled else None
        yield DepthFrame(f"r{index}", step, depth, 1.0, classes, CAMERA, T)


def _lidar_frames(
    lidar: Lidar, poses: Float64Array, index: int, condition: Condition, rng: np.random.Generator
) -> Iterator[CloudFrame]:
    """Clouds of one robot, one a second."""
    mount = np.eye(4)
    mount[2, 3] = LIDAR_HEIGHT
    patches = LabelPatches(condition.patchy_noise, NUM_CLASSES, rng)
    for step in range(0, poses.shape[1], round(RATE)):
        T = poses[index, step] @ mount
        ranges, labels = lidar.take(T, LIDAR_RANGE)
        ranges = np.where(ranges > 0, ranges + 0.02 * rng.standard_normal(ranges.shape), 0).astype(np.float32)
        labels = _noisy(labels, lidar.points(ranges, T), condition, patches, index, rng)
        hit = ranges > 0
        points = lidar.points(ranges, np.eye(4))[hit].astype(np.float32)
        yield CloudFrame(f"r{index}", step, points, labels[hit] if condition.is_labelled else None, T)


def _noisy(
    labels: UInt8Array, points: Float64Array, condition: Condition, patches: LabelPatches, index: int,
    rng: np.random.Generator,
) -> UInt8Array:  # fmt: skip
    """Labels with the errors of the condition."""
    if condition.is_confused:
        # Networks of even robots take roofs for walls and fences for cars, those of odd ones trees for fences.
        swaps = {4: 3, 8: 7} if index % 2 == 0 else {5: 8, 6: 8}
        table = np.arange(256, dtype=np.uint8)
        table[list(swaps)] = list(swaps.values())
        labels = table[labels]
    if condition.patchy_noise:
        labels = patches.apply(labels, points)
    return add_label_noise(labels, condition.label_noise, NUM_CLASSES, rng) if condition.label_noise else labels


def _with_robots(
    camera: MeshCamera, depth: Float32Array, labels: UInt8Array, T_camera: Float64Array, others: Float64Array
) -> tuple[Float32Array, UInt8Array]:
    """The image with the bodies of other robots, labelled as cars."""
    rays = camera.points(np.ones_like(depth), T_camera) - T_camera[:3, 3]
    depth = np.where(depth > 0, depth, np.inf)
    for body in others:
        turn = body[:3, :3].T
        origin, direction = turn @ (T_camera[:3, 3] - body[:3, 3]), rays @ turn.T
        with np.errstate(divide="ignore"):
            ends = (ROBOT_BOX[:, None, None] - origin) / direction
        near, far = ends.min(axis=0).max(axis=-1), ends.max(axis=0).min(axis=-1)
        hit = (near < far) & (near > 0) & (near < depth)
        depth, labels = np.where(hit, near, depth), np.where(hit, np.uint8(7), labels)
    return np.where(np.isfinite(depth), depth, 0).astype(np.float32), labels


def _map(
    frames: Iterator[Frame], drift: Float64Array, sensor: SensorConfig, condition: Condition, rng: np.random.Generator
) -> OwnFrame:
    """Map of frames in a random frame."""
    T_own_village = np.eye(4)
    tilt = Rotation.from_rotvec([*np.radians(rng.uniform(-0.7, 0.7, 2)), 0.0])
    T_own_village[:3, :3] = (tilt * Rotation.from_euler("z", rng.uniform(-180, 180), degrees=True)).as_matrix()
    T_own_village[:3, 3] = (*rng.uniform(-30, 30, 2), rng.uniform(-1, 1))
    num_classes = NUM_CLASSES if condition.is_labelled else 1
    grid = MapConfig(resolution=condition.resolution)
    measured = MeasuredPoints(grid.resolution)
    octree, caster = SemanticOctree(grid.resolution, num_classes), ScanCaster(sensor, grid, num_classes)
    for frame in frames:
        pose = T_own_village @ drift[frame.stamp_ns] @ frame.T_team_sensor
        add_scan(octree, caster.cast(replace(frame, T_team_sensor=pose)), clamped_increments(sensor), 0)
        measured.add_scan(replace(frame, T_team_sensor=pose), sensor)
    own = OwnMap.of_evidence(octree, hit=sensor.hit, miss=sensor.miss, measured=measured)
    return OwnFrame(own, inverse(T_own_village))


def _pairs_within(teams: list[list[OwnFrame]]) -> Iterator[tuple[OwnFrame, OwnFrame]]:
    """Pairs of robots of one village."""
    for team in teams:
        yield from itertools.combinations(team, 2)


def _pairs_across(teams: list[list[OwnFrame]]) -> Iterator[tuple[OwnFrame, OwnFrame]]:
    """Pairs of robots of different villages."""
    for one, other in itertools.combinations(teams, 2):
        yield from itertools.product(one, other)


def _within(a: OwnFrame, b: OwnFrame) -> Outcome:
    """Outcome for two robots of one village."""
    pair, seconds = _timed(a, b)
    T_true = inverse(a.T_village_own) @ b.T_village_own
    shift, angle = _errors(a.own, b.own, pair.T_first_second, T_true)
    return Outcome(pair.is_accepted, pair.refusal, shift, angle, overlap(a.own, b.own, T_true), seconds,
                   pair.verification.score)  # fmt: skip


def _across(a: OwnFrame, b: OwnFrame) -> Outcome:
    """Outcome for two robots of different villages."""
    pair, seconds = _timed(a, b)
    return Outcome(pair.is_accepted, pair.refusal, None, None, 0.0, seconds, pair.verification.score)


def _timed(a: OwnFrame, b: OwnFrame) -> tuple[PairAlignment, float]:
    """Alignment of a pair, and its processor time [s]; surfaces of the maps are made before."""
    for frame in (a, b):
        _ = frame.own.upright_surface.tree, frame.own.columns.known, frame.own.classes_nearby, frame.own.planes
    started = time.process_time()
    return align_team([a.own, b.own]).pairs[0], time.process_time() - started


def overlap(a: OwnMap, b: OwnMap, T_a_b: Float64Array) -> float:
    """Share of the smaller map's obstacle cells with an obstacle of the other map within one and a half cells."""
    one, other = a.obstacles.points, b.obstacles.points @ T_a_b[:3, :3].T + T_a_b[:3, 3]
    if min(len(one), len(other)) == 0:
        return 0.0
    gate = 1.5 * a.resolution
    forth = np.isfinite(cKDTree(other).query(one, distance_upper_bound=gate)[0]).sum()
    back = np.isfinite(cKDTree(one).query(other, distance_upper_bound=gate)[0]).sum()
    return float(min(forth, back) / min(len(one), len(other)))


def _errors(a: OwnMap, b: OwnMap, T: Float64Array, T_true: Float64Array) -> tuple[float, float]:
    """Mean error of the cells that both maps share [m], and error of the rotation [degree]."""
    points = b.upright_surface.points[::5]
    moved = points @ T_true[:3, :3].T + T_true[:3, 3]
    near = np.isfinite(a.upright_surface.tree.query(
        np.column_stack([moved, b.upright_surface.codes[::5] * 1e4]), distance_upper_bound=1.5
    )[0])  # fmt: skip
    if near.sum() >= 20:
        points, moved = points[near], moved[near]
    shift = np.linalg.norm(points @ T[:3, :3].T + T[:3, 3] - moved, axis=1).mean()
    turn = T[:3, :3].T @ T_true[:3, :3]
    return float(shift), math.degrees(math.acos(min(1.0, max(-1.0, (float(np.trace(turn)) - 1) / 2))))


def _report_within(report: Report, condition: Condition, outcomes: list[Outcome]) -> None:
    """Recall by overlap, accuracy, wrong accepts and time."""
    for low, high, must, goal in (
        (0.2, 2.0, None, None),
        (0.1, 2.0, 0.95, 1.0),
        (0.05, 0.1, 0.8, 0.9),
        (0.0, 0.05, None, None),
    ):
        some = [o for o in outcomes if low <= o.overlap < high]
        right = [o for o in some if o.is_accepted and o.is_right(condition)]
        name = (
            f"{condition.name}: recall at overlap {low:g} - {high:g}"
            if high < 2
            else f"{condition.name}: recall at overlap >= {low:g}"
        )
        if some:
            report.add(
                Row(
                    name,
                    len(right) / len(some),
                    "",
                    must=must,
                    goal=goal,
                    more_is_better=True,
                    note=f"{len(right)} of {len(some)}",
                )
            )
    accepted = [o for o in outcomes if o.is_accepted]
    wrong = sum(not o.is_right(condition) for o in accepted)
    report.add(
        Row(f"{condition.name}: wrong poses accepted in a village", wrong, "", must=0, note=f"of {len(outcomes)} pairs")
    )
    if accepted:
        shifts, angles = np.array([(o.shift, o.angle) for o in accepted if o.is_right(condition)], np.float64).T
        for values, unit, median, goal, most, far in (
            (shifts, "m", 0.12, 0.15, 0.5, 0.3),
            (angles, "deg", 0.4, 0.2, 1.5, 1.0),
        ):
            report.add(
                Row(
                    f"{condition.name}: median error",
                    float(np.median(values)),
                    unit,
                    must=median,
                    goal=goal if unit == "deg" else None,
                )
            )
            report.add(
                Row(f"{condition.name}: 95 % error", float(np.percentile(values, 95)), unit, must=most, goal=far)
            )
    seconds = [o.seconds for o in outcomes]
    report.add(
        Row(
            f"{condition.name}: processor time of a pair",
            float(np.mean(seconds)),
            "s",
            min(seconds),
            max(seconds),
            must=1.5,
            goal=0.5,
        )
    )
    for o in outcomes:
        if (o.overlap >= 0.05 and not o.is_accepted) or (o.is_accepted and not o.is_right(condition)):
            state = "accepted" if o.is_accepted else f"refused ({o.refusal})"
            report.remark(
                f"{condition.name}: overlap {o.overlap:.3f}, {state}, error {o.shift:.2f} m, {o.angle:.1f} degrees"
            )


def _report_across(report: Report, condition: Condition, outcomes: list[Outcome]) -> None:
    """False accepts between villages."""
    false = sum(o.is_accepted for o in outcomes)
    report.add(
        Row(f"{condition.name}: false accepts between villages", false, "", must=0, note=f"of {len(outcomes)} pairs")
    )
    highest = max((o.score for o in outcomes), default=0.0)
    report.add(Row(f"{condition.name}: highest L between villages", highest, ""))


def _report_large_team(report: Report, seed: int) -> None:
    """Time of a team of 16 robots."""
    team = make_team(seed, PLAIN, 16, world_size=110.0)
    started = time.monotonic()
    with ThreadPoolExecutor(2) as threads:
        result = align_team([frame.own for frame in team], run=threads.map)
    seconds = time.monotonic() - started
    report.add(Row("16 robots, all pairs, two threads", seconds, "s", must=90, goal=30))
    report.remark(f"16 robots: components of {', '.join(str(len(c)) for c in result.components)} robots")


def _report_iou(report: Report, seeds: Iterable[int]) -> None:
    """Mean IoU of the centralised map with the found frames and with the true ones."""
    losses = []
    for seed in seeds:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            simulation = SimulationConfig(num_robots=4, world_size=45.0, seed=seed, own_frames=True)
            config = load_team_file(simulate_team(folder, simulation).team_file)
            true = {key: transform_of(numbers) for key, numbers in load_frames_file(folder / "frames.yaml").items()}
            team = align_logs(config).teams[0]
            # The village's frame is known through the robot whose frame is the team's.
            root = next(frame.robot_id for frame in team if frame.partner is None)
            found = {frame.robot_id: true[root] @ frame.T_team_map for frame in team}
            ious = [_mean_iou(config, folder, frames) for frames in (found, {key: true[key] for key in found})]
        losses.append(ious[1] - ious[0])
        report.remark(
            f"seed {seed}: {len(team)} of 4 robots aligned, mean IoU {ious[0]:.4f}, with true frames {ious[1]:.4f}"
        )
    report.add(
        Row(
            "loss of mean IoU by found frames",
            float(np.max(losses)),
            "",
            min(losses),
            max(losses),
            must=0.02,
            goal=0.005,
        )
    )


def _mean_iou(config: RunConfig, folder: Path, frames: Mapping[str, Float64Array]) -> float:
    """Mean IoU of the centralised map at the end of a run with these T_team_map (4, 4)."""
    robots = [
        replace(robot, T_team_map=numbers_of(frames[robot.robot_id]))
        for robot in config.robots
        if robot.robot_id in frames
    ]
    replay_team(subteam(config, robots), folder / "result.mcap")
    evaluation = evaluate_result(folder / "result.mcap", truth=folder, over_time=False)
    (folder / "result.mcap").unlink()
    central = next(scores for scores in evaluation.ticks[-1].maps if scores.robot_id == CENTRAL)
    assert central.truth is not None
    return central.truth.mean_iou


if __name__ == "__main__":
    main()
