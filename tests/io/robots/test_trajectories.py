from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from octoreplay.errors import InputError
from octoreplay.io.robots.poses import PoseTrack
from octoreplay.io.robots.trajectories import TrajectoryRows, read_rows, read_times, trajectory
from octoreplay.transforms import pose_matrix
from support.long_suite import examples

IDENTITY = (0.0, 0.0, 0.0, 1.0)
TURN = (0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5))


def test_tum_rows_keep_every_nanosecond(tmp_path):
    path = tmp_path / "tum.txt"
    path.write_text(
        "# time x y z qx qy qz qw\n1700000000.123456789 1 2 3 0 0 0 1\n1700000000.123456790,4,5,6,0,0,2,2\n"
    )
    found = read_rows(path)
    assert found.stamps_ns.tolist() == [1_700_000_000_123_456_789, 1_700_000_000_123_456_790]
    np.testing.assert_array_equal(found.positions, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_allclose(found.rotations, [IDENTITY, TURN])


def test_kitti_rows_are_matrices(tmp_path):
    path = tmp_path / "kitti.txt"
    rotations = Rotation.from_euler("zyx", [[0.1, 0.2, 0.3], [3.1, -0.2, 2.9]])
    matrices = [np.column_stack([m, (i, 2, 3)]) for i, m in enumerate(rotations.as_matrix())]
    path.write_text("\n".join(" ".join(f"{number:.6e}" for number in matrix.ravel()) for matrix in matrices))
    found = read_rows(path)
    assert found.stamps_ns is None
    np.testing.assert_array_equal(found.positions, [[0, 2, 3], [1, 2, 3]])
    np.testing.assert_allclose(Rotation.from_quat(found.rotations).as_matrix(), rotations.as_matrix(), atol=1e-5)


def test_times_are_the_first_number_of_each_line(tmp_path):
    path = tmp_path / "times.txt"
    path.write_text("0.000000e+00\n1.036224e-01 more\n")
    assert read_times(path).tolist() == [0, 103_622_400]


TUM, KITTI = "1 0 0 0 0 0 0 1\n", "1 0 0 0 0 1 0 0 0 0 1 0\n"


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", ": holds no poses"),
        (f"# head\n{TUM}1 2 3\n", " line 3: expects 8 numbers as in the rows before, got 3"),
        (TUM + KITTI, " line 2: expects 8 numbers as in the rows before, got 12"),
        (f"{TUM}x 0 0 0 0 0 0 1\n", " line 2: 'x' is not a time in seconds"),
        (f"{KITTI}1 0 0 0 0 1 0 0 0 0 1 x\n", " line 2: expects numbers, got '1 0 0 0 0 1 0 0 0 0 1 x'"),
        (f"{KITTI}1 0 0 0 0 1 0 0 0 0 2 0\n", " line 2: its upper left 3x3 part is not a rotation"),
        (f"{KITTI}{KITTI}" + "0 " * 12, " line 3: its upper left 3x3 part is not a rotation"),
        # A reflection.
        ("1 0 0 0 0 1 0 0 0 0 -1 0\n", " line 1: its upper left 3x3 part is not a rotation"),
    ],
)
def test_unreadable_rows_are_named_with_their_line(tmp_path, text, sentence):
    path = tmp_path / "poses.txt"
    path.write_text(text)
    with pytest.raises(InputError, match=f"^{re.escape(str(path) + sentence)}") as caught:
        read_rows(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("lost", ["2 0 0 nan 0 0 0 1", "2 0 0 0 0 0 0 0", "2 0 inf 0 0 0 0 1"])
def test_rows_of_lost_tracking_are_ignored(tmp_path, lost):
    path = tmp_path / "poses.txt"
    path.write_text(f"{TUM}{lost}\n3 1 0 0 0 0 0 1\n")
    found = read_rows(path)
    assert [matrix is None for matrix in found.matrices()] == [False, True, False]
    assert trajectory(found.stamps_ns, found).stamps_ns.tolist() == [10**9, 3 * 10**9]


quaternions = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1)


@examples(100)
@given(
    st.lists(st.tuples(st.integers(0, 50), st.tuples(*[st.floats(-10, 10)] * 3), quaternions), min_size=1, max_size=12),
    st.integers(-5, 55), st.integers(1, 40),
)  # fmt: skip
def test_a_trajectory_equals_a_track_of_the_same_poses(entries, stamp, gap):
    """Rows in any order; of two with the same stamp the later one is kept."""
    track = PoseTrack(gap)
    for entry in entries:
        assert track.add(*entry)
    unit = [np.array(q) / np.linalg.norm(q) for _, _, q in entries]
    rows = TrajectoryRows(None, np.array([p for _, p, _ in entries]), np.array(unit))
    found = trajectory(np.array([stamp for stamp, _, _ in entries]), rows)
    assert found.stamps_ns.tolist() == sorted({stamp for stamp, _, _ in entries})
    for at in (stamp, entries[0][0]):
        expected, matrix = track.matrix_at(at), found.matrix_at(at, gap)
        assert (expected is None) == (matrix is None)
        if matrix is not None:
            np.testing.assert_allclose(matrix, expected, atol=1e-9)


def test_the_stamp_of_a_pose_has_that_pose_at_any_gap():
    rows = TrajectoryRows(None, np.array([[1.0, 2, 3], [4, 5, 6]]), np.array([IDENTITY, TURN]))
    found = trajectory(np.array([0, 10**12]), rows)
    np.testing.assert_allclose(found.matrix_at(10**12, 5), pose_matrix((4, 5, 6), TURN))
    assert found.matrix_at(5, 5) is None
