"""Positions in WGS 84: latitude, longitude [degree] and height above the ellipsoid [m], as arrays (n, 3) float64.

Parameters of the ellipsoid and conversions: NGA.STND.0036, Department of Defense World Geodetic System 1984.
"""

from __future__ import annotations

import numpy as np

from octoreplay.records import Float64Array

_SEMI_MAJOR_AXIS, _FLATTENING = 6_378_137.0, 1.0 / 298.257223563
_SQUARED_ECCENTRICITY = _FLATTENING * (2.0 - _FLATTENING)
# Rounds of the latitude's iteration, each of which adds at least two digits.
_ROUNDS = 8


def enu_points(geodetic: Float64Array, origin: Float64Array) -> Float64Array:
    """Return positions (n, 3) [m] east, north and up of an origin (3,), from geodetic positions (n, 3)."""
    return np.asarray((_ecef_points(geodetic) - _ecef_points(origin[None])) @ _axes(origin).T)


def geodetic_points(enu: Float64Array, origin: Float64Array) -> Float64Array:
    """Return geodetic positions (n, 3) of positions (n, 3) [m] east, north and up of an origin (3,)."""
    x, y, z = (_ecef_points(origin[None]) + enu @ _axes(origin)).T
    across = np.hypot(x, y)
    latitude = np.arctan2(z, across * (1.0 - _SQUARED_ECCENTRICITY))
    for _ in range(_ROUNDS):
        radius = _radius(latitude)
        latitude = np.arctan2(z + _SQUARED_ECCENTRICITY * radius * np.sin(latitude), across)
    sin, cos = np.sin(latitude), np.cos(latitude)
    height = across * cos + z * sin - _radius(latitude) * (1.0 - _SQUARED_ECCENTRICITY * sin**2)
    return np.stack([np.degrees(latitude), np.degrees(np.arctan2(y, x)), height], axis=1)


def _axes(origin: Float64Array) -> Float64Array:
    """Directions east, north and up at an origin, in Earth-centred coordinates, as rows (3, 3)."""
    latitude, longitude = np.radians(origin[:2])
    sin_lat, cos_lat, sin_lon, cos_lon = np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude)
    return np.array(
        [
            [-sin_lon, cos_lon, 0.0],
            [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
            [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
        ]
    )


def _radius(latitude: Float64Array) -> Float64Array:
    """Radius of curvature in the prime vertical [m] at latitudes [rad]."""
    return np.asarray(_SEMI_MAJOR_AXIS / np.sqrt(1.0 - _SQUARED_ECCENTRICITY * np.sin(latitude) ** 2))


def _ecef_points(geodetic: Float64Array) -> Float64Array:
    """Earth-centred, Earth-fixed positions (n, 3) [m] of geodetic ones."""
    latitude, longitude = np.radians(geodetic[:, :2]).T
    radius, height = _radius(latitude), geodetic[:, 2]
    across = (radius + height) * np.cos(latitude)
    along = (radius * (1.0 - _SQUARED_ECCENTRICITY) + height) * np.sin(latitude)
    return np.stack([across * np.cos(longitude), across * np.sin(longitude), along], axis=1)
