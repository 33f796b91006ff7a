"""Positions in WGS 84."""

from __future__ import annotations

import math

import numpy as np
import pytest

from octoreplay.geodesy import enu_points, geodetic_points


def test_small_angles_are_arcs_of_the_ellipsoid():
    at_equator = enu_points(np.array([[0.0, 0.001, 0.0]]), np.array([0.0, 0.0, 0.0]))
    assert at_equator[0] == pytest.approx((6_378_137.0 * math.sin(math.radians(0.001)), 0.0, -0.00097), abs=1e-5)
    # The meridian's radius of curvature at 45 degrees.
    along = enu_points(np.array([[45.0005, 9.0, 100.0]]), np.array([44.9995, 9.0, 100.0]))
    assert along[0, :2] == pytest.approx((0.0, (6_367_381.816 + 100.0) * math.radians(0.001)), abs=1e-4)
    above = enu_points(np.array([[-33.0, 151.0, 7.5]]), np.array([-33.0, 151.0, 0.0]))
    assert above[0] == pytest.approx((0.0, 0.0, 7.5), abs=1e-8)


@pytest.mark.parametrize("origin", [(48.0, 11.0, 500.0), (-33.9, 151.2, 0.0), (0.0, -179.9999, 10.0), (89.0, 5.0, 0.0)])
def test_conversions_are_inverse(origin):
    points = np.random.default_rng(0).uniform(-2000, 2000, (50, 3))
    again = enu_points(geodetic_points(points, np.array(origin)), np.array(origin))
    np.testing.assert_allclose(again, points, atol=1e-6)
