"""Rotation and vertical by an IMU: integration against scipy, gaps, damage, standstill and levelling."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from octoreplay.odometry.inertial import InertialMotion, levelled
from octoreplay.records import Float64Array
from support.log_factory import SECOND, Entry, Factory, Row, ros1_row, ros_row

START = 100 * SECOND


def row(stamp: int, rate, up=(0.0, 0.0, 9.81), *, log_time: int | None = None, ros1: bool = False, **fields) -> Row:
    value = Factory(ros1=ros1).imu(stamp, rate, up, **fields)
    make = ros1_row if ros1 else ros_row
    return make(Entry("/imu", "sensor_msgs/msg/Imu", value, stamp if log_time is None else log_time))


def imu_of(rows: list[Row], R_sensor_imu: Float64Array | None = None) -> InertialMotion:
    imu = InertialMotion("/imu", np.eye(3) if R_sensor_imu is None else R_sensor_imu)
    for found in rows:
        imu.take(found.message())
    return imu


def turning(seconds: float) -> Float64Array:
    """Angular velocity about all axes [rad/s]."""
    return np.array([0.4 * np.sin(3 * seconds), 0.3 * np.cos(2 * seconds), 1.5])


@pytest.mark.parametrize("ros1", [False, True])
def test_the_rotation_is_the_integral_of_the_angular_velocity_in_the_sensors_frame(ros1: bool) -> None:
    R_sensor_imu = Rotation.from_euler("xyz", (20, -30, 100), degrees=True)
    rows = [row(START + k * SECOND // 100, turning(k / 100), ros1=ros1) for k in range(102)]
    found = imu_of(rows, R_sensor_imu.as_matrix()).rotation_between(START + 3_000_000, START + SECOND)
    twin = Rotation.identity()
    for k in range(9_970):
        twin = twin * Rotation.from_rotvec(turning(0.003 + (k + 0.5) * 1e-4) * 1e-4)
    expected = R_sensor_imu * twin * R_sensor_imu.inv()
    assert (Rotation.from_matrix(found) * expected.inv()).magnitude() < 1e-4


def test_a_gap_or_a_missing_end_gives_no_rotation() -> None:
    imu = imu_of([row(START + k * SECOND // 100, (0, 0, 1)) for k in range(100) if not 40 < k < 55])
    assert imu.rotation_between(START, START + 400_000_000) is not None
    assert imu.rotation_between(START, START + 600_000_000) is None
    assert imu.rotation_between(START + 450_000_000, START + 600_000_000) is None
    assert imu.rotation_between(START - 1, START + 100_000_000) is None
    assert imu.rotation_between(START + 900_000_000, START + SECOND) is None


def test_damaged_and_late_messages_are_not_used() -> None:
    good = [row(START + k * SECOND // 100, (0, 0, 1)) for k in range(11)]
    bad = [
        good[5]._replace(data=good[5].data[:40]),
        row(START + 50_000_001, (0, 0, np.nan)),
        row(START + 50_000_002, (0, 0, 1e9)),
        row(START + 50_000_003, (0, 0, 5), unmeasured=("angular_velocity",)),
        row(START + 20_000_000, (0, 0, 5)),
        row(START + 9_000 * SECOND, (0, 0, 5), log_time=START + 50_000_004),
    ]
    imu = imu_of(good[:6] + bad + good[6:])
    assert imu.num_unusable == len(bad)
    turned = imu.rotation_between(START, START + SECOND // 10)
    assert Rotation.from_matrix(turned).magnitude() == pytest.approx(0.1, abs=1e-9)


@pytest.mark.parametrize("gravity", [9.81, 1.0])
def test_a_standstill_gives_the_bias_and_the_vertical(gravity: float) -> None:
    tilt = Rotation.from_euler("xy", (25, -10), degrees=True)
    up, rng = tilt.inv().apply((0, 0, 1)), np.random.default_rng(0)
    bias = np.array([0.01, -0.02, 0.005])
    rows = [
        row(START + k * SECOND // 100, bias + 0.002 * rng.standard_normal(3),
            gravity * (up + 0.003 * rng.standard_normal(3)))
        for k in range(70)
    ]  # fmt: skip
    imu = imu_of(rows)
    imu.begin(START)
    np.testing.assert_allclose(imu.bias, bias, atol=1e-3)
    assert np.degrees(np.arccos(imu.up @ up)) < 0.2
    T = levelled(np.eye(4), imu.up)
    assert np.degrees(np.arccos((T[:3, :3] @ up)[2])) < 0.2
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
    assert T[1, :3] @ (1, 0, 0) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(
    ("rate", "up", "num"),
    [((0, 0, 0.5), (0, 0, 9.81), 100), ((0, 0, 0), (0, 4, 9.81), 100), ((0, 0, 0), (0, 0, 9.81), 40)],
)
def test_motion_and_short_standstills_give_no_vertical(rate, up, num: int) -> None:
    imu = imu_of([row(START + k * SECOND // 100, rate, up) for k in range(num)])
    imu.begin(START)
    assert imu.up is None
    assert not imu.bias.any()


def test_without_acceleration_there_is_no_vertical_but_a_rotation() -> None:
    rows = [row(START + k * SECOND // 100, (0, 0, 0), unmeasured=("linear_acceleration",)) for k in range(100)]
    imu = imu_of(rows)
    imu.begin(START)
    assert imu.up is None
    assert imu.to(START + SECOND // 10) is not None
