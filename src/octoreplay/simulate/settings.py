"""Settings of a simulation."""

from __future__ import annotations

import math
from dataclasses import dataclass

from octoreplay.errors import ConfigError
from octoreplay.records import CameraModel, ClassTable
from octoreplay.simulate.colour import COLOUR_FORMATS
from octoreplay.simulate.confidences import largest_label_noise
from octoreplay.simulate.lidar import LidarModel
from octoreplay.simulate.world import MAX_KINDS, village_classes

SENSORS = ("camera", "lidar")
"""Sensors of simulated robots: a depth camera, or a spinning LiDAR."""


@dataclass(frozen=True)
class SimulationConfig:
    """Settings of a simulation. Raises ConfigError for a value out of range.

    Attributes
    ----------
    num_robots : int
        Number of robots.
    duration : float
        Length of the logs [s].
    rate : float
        Images or scans per second and robot [Hz].
    sensor : str
        'camera' for depth and label images, 'lidar' for labelled point clouds.
    image : tuple of int
        Width and height of the images [pixels].
    scan : tuple of int
        Number of rings and of columns of a LiDAR's scan.
    scan_view : tuple of float
        Elevations of a LiDAR's lowest and highest ring [degree].
    scan_range : float
        Range of a LiDAR [m].
    seed : int
        Seed of the village and of all noise.
    resolution : float
        Cell size of the ground truth, and resolution in the team file [m].
    label_noise : float
        Share of the pixels or points that get a wrong class.
    patchy_noise : float
        Share of the cubes of 2 m in which a robot's labels are always wrong; drawn for each robot.
    similar_errors : bool
        True where a wrong label is that of the class which resembles the right one: grass and road, building and roof,
        trunk and foliage, fence and car. False for any other class, each equally likely.
    confidences : float or None
        Temperature of the network whose confidences come with the labels: 1 for calibrated ones, less for too high
        ones; None for logs without confidences. Labels are then wrong with probabilities that differ between places
        and pixels, with the mean ``label_noise``.
    depth_noise : float
        Factor on the standard deviation of the noise of a depth camera, or of a LiDAR's ranges.
    pose_noise : float
        Standard deviation of the recorded x and y [m]; a tenth of it is that of the heading [rad].
    odometry_drift : tuple of float
        Drift of the recorded poses as in dead reckoning: position [% of the way], heading [degrees per 10 m of way].
    own_frames : bool
        True to record each robot's poses in a frame of its own, which starts at its first pose. The robots start with
        random headings.
    fixes : float or None
        Standard deviation of a horizontal coordinate of position fixes [m], one each second; None for logs without.
    kinds_per_class : int
        Number of classes that each of the eight classes is divided into.
    has_labels : bool
        False for logs without labels and LabelInfo.
    colour : str or None
        Form of the colour images: 'raw', 'jpeg' or 'png'; None for logs without colour images.
    colour_offset : tuple of float
        Position of the colour camera in the depth camera's optical frame [m]; zeros for images aligned to depth.
    world_size : float
        Edge length of the drivable square [m].
    identical_houses : bool
        True for a village that repeats itself: copies of one house between straight roads on flat ground.
    max_depth : float
        Range of the camera [m].
    speed : float
        Speed of the robots [m/s].
    paths : tuple
        Path of each robot as a tuple of its waypoints (x, y) [m] (``load_paths_file``). Without paths the robots
        explore the village.
    """

    num_robots: int = 6
    duration: float = 60.0
    rate: float = 4.0
    sensor: str = "camera"
    image: tuple[int, int] = (160, 120)
    scan: tuple[int, int] = (64, 1024)
    scan_view: tuple[float, float] = (-22.5, 22.5)
    scan_range: float = 100.0
    seed: int = 0
    resolution: float = 0.3
    label_noise: float = 0.1
    patchy_noise: float = 0.0
    similar_errors: bool = False
    confidences: float | None = None
    depth_noise: float = 1.0
    pose_noise: float = 0.0
    odometry_drift: tuple[float, float] = (0.0, 0.0)
    own_frames: bool = False
    fixes: float | None = None
    kinds_per_class: int = 1
    has_labels: bool = True
    colour: str | None = None
    colour_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    world_size: float = 70.0
    identical_houses: bool = False
    max_depth: float = 20.0
    speed: float = 1.0
    paths: tuple[tuple[tuple[float, float], ...], ...] = ()

    def __post_init__(self) -> None:
        for name, value, least, most in (
            ("num_robots", self.num_robots, 1, 100),
            ("duration", self.duration, 1.0, 86_400.0),
            ("rate", self.rate, 0.1, 100.0),
            ("image width", self.image[0], 8, 4096),
            ("image height", self.image[1], 6, 4096),
            ("rings of scan", self.scan[0], 1, 1024),
            ("columns of scan", self.scan[1], 4, 8192),
            *(("scan_view", value, -90.0, 90.0) for value in self.scan_view),
            ("scan_range", self.scan_range, 1.0, 500.0),
            ("seed", self.seed, 0, 2**32 - 1),
            ("resolution", self.resolution, 0.02, 5.0),
            ("label_noise", self.label_noise, 0.0, 1.0),
            ("patchy_noise", self.patchy_noise, 0.0, 1.0),
            ("confidences", 1.0 if self.confidences is None else self.confidences, 0.01, 100.0),
            ("depth_noise", self.depth_noise, 0.0, 100.0),
            ("pose_noise", self.pose_noise, 0.0, 10.0),
            ("odometry_drift in percent", self.odometry_drift[0], 0.0, 100.0),
            ("odometry_drift in degrees per 10 m", self.odometry_drift[1], 0.0, 90.0),
            ("fixes", 0.001 if self.fixes is None else self.fixes, 0.001, 1000.0),
            ("kinds_per_class", self.kinds_per_class, 1, MAX_KINDS),
            *(("colour_offset", value, -5.0, 5.0) for value in self.colour_offset),
            ("world_size", self.world_size, 20.0, 1000.0),
            ("max_depth", self.max_depth, 1.0, 65.0),
            ("speed", self.speed, 0.01, 50.0),
        ):
            if not least <= value <= most:
                raise ConfigError(f"{name}: {value:g} is not between {least:g} and {most:g}")
        if self.colour not in (None, *COLOUR_FORMATS):
            raise ConfigError(f"colour: '{self.colour}' is not one of {', '.join(COLOUR_FORMATS)}")
        if any(self.colour_offset) and self.colour is None:
            raise ConfigError("colour_offset: needs colour images")
        if self.sensor not in SENSORS:
            raise ConfigError(f"sensor: '{self.sensor}' is not one of {', '.join(SENSORS)}")
        if self.is_lidar and self.colour is not None:
            raise ConfigError("colour: a LiDAR takes no images; use the sensor 'camera'")
        if not self.scan_view[0] < self.scan_view[1]:
            raise ConfigError("scan_view: the lowest ring must be below the highest")
        if self.confidences is not None:
            self._check_confidences()
        self._check_paths()

    def _check_confidences(self) -> None:
        """Raise ConfigError for logs without labels, and for more label noise than confidences can say."""
        most = largest_label_noise(self.num_candidates)
        if not self.has_labels:
            raise ConfigError("confidences: a log without labels has no confidences; leave one of the options out")
        if self.label_noise > most:
            raise ConfigError(
                f"label_noise: {self.label_noise:g} is above {most:g}, the share of wrong labels among"
                f" {self.num_candidates} classes at random; lower it, or leave out confidences"
            )

    def _check_paths(self) -> None:
        """Raise ConfigError for another number of paths than robots, and for waypoints outside of the village."""
        if self.paths and len(self.paths) != self.num_robots:
            raise ConfigError(f"paths: {len(self.paths)} paths do not fit {self.num_robots} robots; give one for each")
        for robot_id, path in zip(self.robot_ids, self.paths, strict=False):
            for x, y in path:
                if not max(abs(x), abs(y)) <= self.world_size / 2:
                    raise ConfigError(
                        f"paths: {robot_id}: waypoint ({x:g}, {y:g}) is outside of the village of {self.world_size:g} m"
                        " around the origin; move it, or raise world_size"
                    )

    @property
    def is_lidar(self) -> bool:
        """True for robots with a LiDAR."""
        return self.sensor == "lidar"

    @property
    def lidar(self) -> LidarModel:
        """LiDAR of the robots."""
        low, high = self.scan_view
        return LidarModel(*self.scan, math.radians(low), math.radians(high))

    @property
    def camera(self) -> CameraModel:
        """Camera of the robots: fx = fy = 65.25 pixels at a width of 160 pixels, principal point at the centre."""
        width, height = self.image
        focal = 65.25 * width / 160
        return CameraModel(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)

    @property
    def class_table(self) -> ClassTable:
        """Classes of the labels."""
        return village_classes(self.kinds_per_class)

    @property
    def num_candidates(self) -> int:
        """Number of classes that a label may be: the right one, and those that an error can give."""
        return 2 if self.similar_errors else self.class_table.num_classes

    @property
    def has_pose_truth(self) -> bool:
        """True if the true frames and trajectories are written, because the recorded ones differ from them."""
        return self.own_frames or self.pose_noise > 0 or any(self.odometry_drift)

    @property
    def robot_ids(self) -> tuple[str, ...]:
        """Names of the robots: husky_1, husky_2, ..."""
        return tuple(f"husky_{index + 1}" for index in range(self.num_robots))
