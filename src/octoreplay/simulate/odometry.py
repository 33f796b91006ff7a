"""Localisation of simulated robots: drift of dead reckoning, frames that start at the first pose, position fixes."""

from __future__ import annotations

import math

import numpy as np

from octoreplay.geodesy import geodetic_points
from octoreplay.records import Float64Array

MAX_TILT = math.radians(1.0)
"""Largest angle between the vertical and the z axis of a robot's own frame [rad]."""

FIX_ORIGIN = np.array([48.0, 11.0, 500.0])
"""Latitude, longitude [degree] and height above the ellipsoid [m] of the village's origin; x is east, y north."""

HEIGHT_FACTOR = 2.0
"""Standard deviation of a fix's height, relative to that of a horizontal coordinate."""

_REFERENCE_WAY = 50.0
_BIAS_SHARE = 0.9
_BOUNDED_WAY = 10.0
_BOUNDED_TILT_SHARE = 0.2


def drift_corrections(
    T_map_body: Float64Array, percent: float, degrees: float, rng: np.random.Generator
) -> Float64Array:
    """Draw the drift of a robot's odometry as transforms D (T, 4, 4): D[i] @ T_map_body[i] is the odometry's pose i.

    ``T_map_body`` (T, 4, 4) are the true poses. The odometry starts at the first of them and integrates the robot's
    motions with errors; s is the horizontal way [m], so that a robot at rest or turning on the spot does not drift.

    - Systematic part, drawn once: a scale error of the way and a turn per metre. They dominate on firm ground
      (Borenstein and Feng, Measurement and Correction of Systematic Odometry Errors in Mobile Robots, T-RA 1996).
    - Random part: white errors of position, along and across, and of heading, with variances in proportion to the way
      (Chong and Kleeman, Accurate Odometry and Error Modelling for a Mobile Robot, ICRA 1997).

    After a straight way of s = 50 m the standard deviation is ``percent`` / 100 * s in position, without the effect of
    the heading's error, and ``degrees`` * s / 10 m in heading. The systematic part has 0.9 of both variances there. The
    heading's error also turns the way that follows.

    Height, roll and pitch are bounded, as with a barometer and an inertial unit: first-order Gauss-Markov processes
    along the way that start at 0, with a correlation length of 10 m. Their standard deviations are at most
    ``percent`` / 100 * 10 m and ``degrees`` / 5.
    """
    from scipy.spatial.transform import Rotation

    # One row of draws per motion: a longer log begins with the errors of a shorter one.
    scale_draw, turn_draw = rng.standard_normal(2)
    draws = rng.standard_normal((len(T_map_body) - 1, 6))
    motions = np.diff(T_map_body[:, :2, 3], axis=0)
    ways = np.hypot(*motions.T)
    per_metre = np.array([percent / 100.0, math.radians(degrees / 10.0)])
    scale, turn = per_metre * math.sqrt(_BIAS_SHARE) * (scale_draw, turn_draw)
    white_position, white_heading = per_metre * math.sqrt((1.0 - _BIAS_SHARE) * _REFERENCE_WAY)
    heading = np.append(0.0, np.cumsum(turn * ways + white_heading * np.sqrt(ways) * draws[:, 0]))
    # Half of the white variance is along the way, half across it.
    moved = (1.0 + scale) * motions + white_position * np.sqrt(ways / 2.0)[:, None] * draws[:, 1:3]
    cos, sin = np.cos(heading[:-1]), np.sin(heading[:-1])
    turned = np.stack([cos * moved[:, 0] - sin * moved[:, 1], sin * moved[:, 0] + cos * moved[:, 1]], axis=1)
    positions = T_map_body[:, :3, 3].copy()
    positions[1:, :2] = positions[0, :2] + np.cumsum(turned, axis=0)
    tilt = _BOUNDED_TILT_SHARE * math.radians(degrees)
    bounded = _bounded_errors(ways, draws[:, 3:]) * (tilt, tilt, percent / 100.0 * _BOUNDED_WAY)
    positions[:, 2] += bounded[:, 2]
    yaws = Rotation.from_rotvec(heading[:, None] * (0.0, 0.0, 1.0))
    corrections = np.tile(np.eye(4), (len(T_map_body), 1, 1))
    corrections[:, :3, :3] = (yaws * Rotation.from_rotvec(bounded * (1.0, 1.0, 0.0))).as_matrix()
    corrections[:, :3, 3] = positions - np.einsum("tij,tj->ti", corrections[:, :3, :3], T_map_body[:, :3, 3])
    return corrections


def own_frame(T_map_body: Float64Array, rng: np.random.Generator) -> Float64Array:
    """Draw the frame of a robot's odometry as T_map_odom (4, 4): its origin is the first pose, its x axis forward.

    ``T_map_body`` (4, 4) is the first true pose. z is vertical but for a tilt about a random horizontal axis, the error
    of the inertial unit at the start: its angle is uniform between 0 and ``MAX_TILT``.
    """
    from scipy.spatial.transform import Rotation

    angle, direction = rng.uniform(0.0, MAX_TILT), rng.uniform(0.0, 2 * math.pi)
    tilt = Rotation.from_rotvec(angle * np.array([math.cos(direction), math.sin(direction), 0.0]))
    heading = math.atan2(T_map_body[1, 0], T_map_body[0, 0])
    T_map_odom = np.eye(4)
    T_map_odom[:3, :3] = (Rotation.from_rotvec([0.0, 0.0, heading]) * tilt).as_matrix()
    T_map_odom[:3, 3] = T_map_body[:3, 3]
    return T_map_odom


def position_fixes(positions: Float64Array, sigma: float, rng: np.random.Generator) -> Float64Array:
    """Draw position fixes (n, 3) of true positions (n, 3) [m]: latitude, longitude [degree] and height [m] in WGS 84.

    ``sigma`` is the standard deviation of a horizontal coordinate [m]. One half of the variance is an error that all
    fixes share, as of the satellites' orbits and clocks and of the atmosphere; the other half is white.
    """
    draws = rng.standard_normal((len(positions) + 1, 3)) * (1.0, 1.0, HEIGHT_FACTOR) * sigma / math.sqrt(2.0)
    return geodetic_points(positions + draws[0] + draws[1:], FIX_ORIGIN)


def _bounded_errors(ways: Float64Array, draws: Float64Array) -> Float64Array:
    """Gauss-Markov processes (T, K) along the way from 0 towards a standard deviation of 1; draws are (T - 1, K)."""
    keeps = np.exp(-ways / _BOUNDED_WAY)
    steps = np.sqrt(1.0 - keeps**2)[:, None] * draws
    errors = np.zeros((len(ways) + 1, draws.shape[1]))
    for i, (keep, step) in enumerate(zip(keeps, steps, strict=True)):
        errors[i + 1] = keep * errors[i] + step
    return errors
