"""Layouts of trajectory files: detection, conversion and refusal."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from octoreplay.errors import InputError
from octoreplay.io.robots.trajectories import read_rows
from support.recordings import RECORDINGS

STAMPS = (1_403_636_580_838_555_648, 1_403_636_580_843_555_328, 1_403_636_580_848_555_520)
POSES = [((float(k), -2.0 * k, 0.5), Rotation.from_euler("zyx", [0.4 * k + 0.3, 0.1, -0.2])) for k in range(3)]


def row(index: int, order: str = "xyzw", *, separator: str = " ", time: str | None = None) -> str:
    position, rotation = POSES[index]
    quaternion = dict(zip("xyzw", rotation.as_quat(), strict=True))
    numbers = [*map(repr, position), *(repr(float(quaternion[axis])) for axis in order)]
    return separator.join(numbers if time is None else [time, *numbers])


def matrix(index: int) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = POSES[index][1].as_matrix(), POSES[index][0]
    return T


def write(folder: Path, text: str, name: str = "poses.txt") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def check(path: Path, pose_format: str | None = None, stamps: tuple[int, ...] | None = STAMPS) -> None:
    found = read_rows(path, pose_format)
    assert (None if found.stamps_ns is None else tuple(found.stamps_ns.tolist())) == stamps
    np.testing.assert_allclose(np.array(found.matrices()), [matrix(k) for k in range(3)], atol=1e-12)


EUROC_HEADER = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], "
    "v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], b_w_RS_S_x [rad s^-1], b_w_RS_S_y [rad s^-1], "
    "b_w_RS_S_z [rad s^-1], b_a_RS_S_x [m s^-2], b_a_RS_S_y [m s^-2], b_a_RS_S_z [m s^-2]"
)
REST = "," + ",".join(["0.25"] * 9)


@pytest.mark.parametrize("header", [EUROC_HEADER, "# recorded by a motion capture system", ""])
def test_ground_truth_of_euroc_has_w_first_with_and_without_its_header(tmp_path, header):
    rows = [row(k, "wxyz", separator=",", time=str(stamp)) + REST for k, stamp in enumerate(STAMPS)]
    check(write(tmp_path, "\n".join([header, *rows]), "data.csv"))


@pytest.mark.parametrize(
    ("header", "order"),
    [
        ("#timestamp_kf,x,y,z,qw,qx,qy,qz", "wxyz"),
        ("# timestamp, x, y, z, qx, qy, qz, qw", "xyzw"),
        ("time,tx,ty,tz,orientation_w,orientation_x,orientation_y,orientation_z", "wxyz"),
        ("stamp,pos_x,pos_y,pos_z,q_x,q_y,q_z,q_w", "xyzw"),
    ],
)
def test_a_header_gives_the_order_of_the_quaternion(tmp_path, header, order):
    rows = [row(k, order, separator=",", time=str(stamp)) for k, stamp in enumerate(STAMPS)]
    check(write(tmp_path, "\n".join([header, *rows])))


@pytest.mark.parametrize(("pose_format", "order"), [("euroc", "wxyz"), ("tum", "xyzw")])
def test_eight_columns_with_nanoseconds_need_a_format(tmp_path, pose_format, order):
    path = write(tmp_path, "\n".join(row(k, order, time=str(stamp)) for k, stamp in enumerate(STAMPS)))
    with pytest.raises(InputError, match=r"no header tells whether w comes first; give pose_format: euroc"):
        read_rows(path)
    check(path, pose_format)


def test_a_time_beyond_the_range_of_stamps_is_refused(tmp_path):
    with pytest.raises(InputError, match="line 1: '9999999999999999999' is not a time"):
        read_rows(write(tmp_path, "9999999999999999999 0 0 0 0 0 0 1\n"), "tum")


def test_a_format_that_contradicts_the_header_is_refused(tmp_path):
    rows = [row(k, "wxyz", time=str(stamp)) for k, stamp in enumerate(STAMPS)]
    path = write(tmp_path, "\n".join(["# time x y z qw qx qy qz", *rows]))
    with pytest.raises(InputError, match=r"its header names the columns .* which are not those of pose_format tum"):
        read_rows(path, "tum")
    check(path, "euroc")


def test_matrices_have_one_line_each_or_are_stacked(tmp_path):
    matrices = [matrix(k) for k in range(3)]
    for count, size in ((16, 4), (12, 3)):
        lines = [" ".join(map(repr, T[:size].ravel().tolist())) for T in matrices]
        check(write(tmp_path, "\n".join(lines), f"{count}.txt"), stamps=None)
        blocks = ["\n".join(" ".join(map(repr, line)) for line in T[:size].tolist()) for T in matrices]
        check(write(tmp_path, "\n\n".join(blocks), f"stacked_{size}.txt"), stamps=None)
    redwood = "\n".join(f"{k} {k} {k + 1}\n{block}" for k, block in enumerate(stacked(matrices)))
    check(write(tmp_path, redwood, "trajectory.log"), stamps=None)
    with pytest.raises(InputError, match=r"expects blocks .* it is cut"):
        read_rows(write(tmp_path, redwood.rsplit("\n", 1)[0], "cut.log"))


def stacked(matrices: list[np.ndarray]) -> list[str]:
    return ["\n".join(" ".join(map(repr, line)) for line in T.tolist()) for T in matrices]


def test_transposed_matrices_are_refused(tmp_path):
    lines = [" ".join(map(repr, matrix(k).T.ravel().tolist())) for k in range(3)]
    with pytest.raises(InputError, match="may be transposed"):
        read_rows(write(tmp_path, "\n".join(lines)))


@pytest.mark.parametrize("columns", [slice(1, 4), slice(0, 4)])
def test_positions_without_rotations_are_refused(tmp_path, columns):
    rows = [" ".join(row(k, time=str(k + 0.5)).split()[columns]) for k in range(3)]
    with pytest.raises(InputError, match="holds positions without rotations"):
        read_rows(write(tmp_path, "\n".join(rows)))


def test_a_moving_track_of_identity_rotations_is_refused_unless_its_format_is_given(tmp_path):
    path = write(tmp_path, "1.5 744073.3 2553112.0 0.2 0 0 0 1\n2.5 744079.3 2553112.0 0.2 0 0 0 1\n")
    with pytest.raises(InputError, match=r"rotation of all 2 poses is the identity along 6.0 m"):
        read_rows(path)
    found = read_rows(path, "tum", (744_000, 2_553_000, 0))
    np.testing.assert_allclose(found.positions, [[73.3, 112.0, 0.2], [79.3, 112.0, 0.2]], atol=1e-9)


def test_utm_coordinates_need_an_origin_and_the_error_gives_one(tmp_path):
    path = write(tmp_path, "1.5 477146.27 4428491.08 1630.5 0 0 0.6 0.8\n2.5 477147.27 4428491.08 1630.5 0 0 0.6 0.8")
    with pytest.raises(InputError, match=r"give pose_origin: \[477000, 4428000, 1630\], the same for every robot"):
        read_rows(path)
    found = read_rows(path, origin=(477_000, 4_428_000, 1630))
    np.testing.assert_allclose(found.positions, [[146.27, 491.08, 0.5], [147.27, 491.08, 0.5]], atol=1e-9)
    with pytest.raises(InputError, match="its positions reach"):
        read_rows(path, origin=(0, 0, 0))


def test_latitude_and_longitude_become_metres_east_north_and_up_of_the_origin(tmp_path):
    rows = ["1.5,48.0,11.0,500.0,0,0,0.6,0.8", "2.5,48.0001,11.0001,501.0,0,0,0.6,0.8"]
    path = write(tmp_path, "\n".join(["time,latitude,longitude,altitude,qx,qy,qz,qw", *rows]))
    with pytest.raises(InputError, match=r"give pose_origin: \[48.00000, 11.00000, 500\]"):
        read_rows(path)
    found = read_rows(path, origin=(48.0, 11.0, 500.0))
    # One degree of latitude is 111.19 km there, and one of longitude 74.63 km (WGS 84).
    np.testing.assert_allclose(found.positions, [[0, 0, 0], [7.463, 11.12, 1.0]], atol=0.01)
    plain = write(tmp_path, "\n".join(line.replace(",", " ") for line in rows), "plain.txt")
    np.testing.assert_array_equal(read_rows(plain, "geodetic", (48.0, 11.0, 500.0)).positions, found.positions)


def test_north_east_down_becomes_forward_left_up(tmp_path):
    """Half a turn about x on both sides: yaw to the right becomes yaw to the left of the opposite sign."""
    x, y, z, w = Rotation.from_euler("z", 30, degrees=True).as_quat()
    path = write(tmp_path, f"1 2 3 {x} {y} {z} {w}\n")
    found = read_rows(path, "tartanair")
    np.testing.assert_allclose(found.positions, [[1, -2, -3]])
    np.testing.assert_allclose(Rotation.from_quat(found.rotations[0]).as_euler("zyx", degrees=True), [-30, 0, 0])
    with pytest.raises(InputError, match="got 7; for other layouts name the columns in a header"):
        read_rows(path)


@pytest.mark.skipif(not RECORDINGS.is_dir(), reason="the folder of recordings is not here")
def test_the_reference_of_cu_multi_is_in_utm_coordinates():
    path = RECORDINGS / "multirobot" / "cu_multi" / "main_campus_robot1_ref.csv"
    with pytest.raises(InputError, match=r"give pose_origin: \[477000, 4428000, 1631\]"):
        read_rows(path)
    found = read_rows(path, origin=(477_000, 4_428_000, 1631))
    np.testing.assert_allclose(found.positions[0], [146.27990973, 491.08631844, -0.43497], atol=1e-5)


def test_a_header_of_another_width_than_the_rows_is_refused(tmp_path):
    path = write(tmp_path, "time,x,y,z,qx,qy,qz,qw\n1,2,3,4,0,0,0\n")
    with pytest.raises(InputError, match="line 2: expects 8 columns as in the header, got 7"):
        read_rows(path)
