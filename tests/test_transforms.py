from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as st_np
from scipy.spatial.transform import Rotation, Slerp

from octoreplay.transforms import (
    interpolate,
    inverse,
    normalise,
    pose_matrix,
    rotation_to_quaternion,
    slerp,
    transform_of,
)
from support.long_suite import examples

IDENTITY = (0.0, 0.0, 0.0, 1.0)

quaternions = (
    st_np.arrays(np.float64, 4, elements=st.floats(-1, 1))
    .filter(lambda q: np.linalg.norm(q) > 1e-2)
    .map(lambda q: tuple((q / np.linalg.norm(q)).tolist()))
)
positions = st.tuples(*[st.floats(-1e3, 1e3)] * 3)


@examples(100)
@given(quaternions, positions)
def test_pose_matrix_equals_scipy(quaternion, position):
    matrix = pose_matrix(position, quaternion)
    np.testing.assert_allclose(matrix[:3, :3], Rotation.from_quat(quaternion).as_matrix(), atol=1e-12)
    np.testing.assert_array_equal(matrix[:3, 3], position)
    np.testing.assert_allclose(matrix @ inverse(matrix), np.eye(4), atol=1e-9)


@examples(100)
@given(quaternions, quaternions, st.floats(0, 1))
def test_slerp_equals_scipy(first, second, fraction):
    # Half a turn apart, both arcs are equally short.
    if abs(np.dot(first, second)) < 1e-3:
        return
    ours = Rotation.from_quat(slerp(first, second, fraction))
    theirs = Slerp([0, 1], Rotation.from_quat([first, second]))(fraction)
    assert (ours * theirs.inv()).magnitude() < 1e-6


def test_slerp_takes_the_shorter_arc():
    half = normalise((0.0, 0.0, 1.0, 1.0))
    negative = tuple(-value for value in half)
    assert slerp(IDENTITY, negative, 0.0) == pytest.approx(IDENTITY)
    angle = Rotation.from_quat(slerp(IDENTITY, negative, 0.5)).magnitude()
    assert angle == pytest.approx(np.pi / 4)


@examples(100)
@given(quaternions, quaternions, positions, positions, st.floats(0, 1))
def test_interpolation_is_linear_in_position_and_slerp_in_rotation(first, second, start, end, fraction):
    position, quaternion = interpolate((start, first), (end, second), fraction)
    np.testing.assert_allclose(position, np.array(start) + fraction * (np.array(end) - start), atol=1e-9)
    assert quaternion == slerp(first, second, fraction)


@pytest.mark.parametrize("bad", [(0, 0, 0, 0), (np.nan, 0, 0, 1), (np.inf, 0, 0, 1), (1e200, 0, 0, 1e200)])
def test_quaternions_of_length_0_and_not_finite_ones_are_refused(bad):
    assert normalise(bad) is None
    with pytest.raises(ValueError, match="length 0 or is not finite"):
        transform_of((0, 0, 0, *bad))


@examples(100)
@given(quaternions, positions, st.floats(1e-2, 1e2))
def test_transform_of_seven_numbers_normalises_the_quaternion(quaternion, position, length):
    found = transform_of((*position, *(length * value for value in quaternion)))
    np.testing.assert_allclose(found, pose_matrix(position, quaternion), atol=1e-12)


@examples(100)
@given(quaternions)
def test_rotation_to_quaternion_inverts_the_conversion_to_a_matrix(quaternion):
    rotation = Rotation.from_quat(quaternion).as_matrix()
    found = rotation_to_quaternion(rotation)
    assert found[3] >= 0
    np.testing.assert_allclose(np.linalg.norm(found), 1.0, atol=1e-12)
    np.testing.assert_allclose(Rotation.from_quat(found).as_matrix(), rotation, atol=1e-12)


@pytest.mark.parametrize("axis", [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, 0.8, 0], [0, -0.6, 0.8]])
def test_rotation_to_quaternion_of_half_turns(axis):
    rotation = Rotation.from_rotvec(np.pi * np.array(axis)).as_matrix()
    np.testing.assert_allclose(Rotation.from_quat(rotation_to_quaternion(rotation)).as_matrix(), rotation, atol=1e-9)
