from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from log_factory import ros2
from octoreplay.errors import InputError
from octoreplay.io.containers.log_reader import DamagedMessageError
from octoreplay.io.sensors.clouds import decode_cloud, label_field

HERE = "a.mcap: topic '/points' at 1.000 s"


def columns_of(num: int, kind: str = "f4", **more: np.ndarray) -> dict[str, np.ndarray]:
    values = np.arange(1, 3 * num + 1, dtype=kind).reshape(num, 3) / 4
    return {"x": values[:, 0], "y": values[:, 1], "z": values[:, 2], **more}


@given(
    st.integers(1, 4), st.integers(1, 5), st.sampled_from(["f4", "f8"]), st.integers(0, 5), st.integers(0, 9),
    st.booleans(), st.sampled_from(["i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"]),
)  # fmt: skip
def test_points_and_labels_come_out_as_they_went_in(height, width, kind, gap, padding, big_endian, label_kind):
    num = height * width
    labels = (np.arange(num) % 100).astype(label_kind)
    columns = columns_of(num, kind, intensity=np.ones(num, "f4"), label=labels)
    cloud = ros2.cloud(0, columns, gap=gap, height=height, row_padding=padding, big_endian=big_endian)
    points, raw = decode_cloud(cloud, HERE)
    assert points.dtype == np.dtype(kind)
    assert points.flags.c_contiguous
    np.testing.assert_array_equal(points, np.stack([columns["x"], columns["y"], columns["z"]], axis=1))
    assert raw.dtype == np.int64
    np.testing.assert_array_equal(raw, labels)


def test_rows_that_are_not_finite_or_at_the_sensor_are_left_out_with_their_labels():
    columns = columns_of(5, label=np.array([5, 6, 7, 8, 9], "u2"))
    columns = {name: column.copy() for name, column in columns.items()}
    columns["y"][1], columns["y"][2] = np.nan, np.inf
    for name in "xyz":
        columns[name][4] = 0.0
    points, raw = decode_cloud(ros2.cloud(0, columns), HERE)
    assert points.shape == (2, 3)
    assert raw.tolist() == [5, 8]


def test_a_cloud_without_labels_and_one_without_points():
    cloud = ros2.cloud(0, columns_of(3))
    assert label_field(cloud) is None
    assert decode_cloud(cloud, HERE)[1] is None
    empty = ros2.cloud(0, columns_of(2, label=np.zeros(2, "u1")))
    empty.width, empty.row_step, empty.data = 0, 0, empty.data[:0]
    points, raw = decode_cloud(empty, HERE)
    assert points.shape == (0, 3)
    assert raw.shape == (0,)


def test_the_first_known_label_field_is_taken():
    assert label_field(ros2.cloud(0, columns_of(1, class_id=np.ones(1, "u1"), semantic=np.ones(1, "u1")))) == "semantic"


def test_a_label_that_is_no_number_is_minus_one():
    _, raw = decode_cloud(ros2.cloud(0, columns_of(2, label=np.array([np.nan, 3], "f4"))), HERE)
    assert raw.tolist() == [-1, 3]


def test_missing_and_odd_fields_are_refused():
    columns = columns_of(2)
    del columns["z"]
    with pytest.raises(InputError, match="no usable field 'z'; its fields are x, y"):
        decode_cloud(ros2.cloud(0, columns), HERE)
    integers = {name: np.zeros(2, "i4") for name in "xyz"}
    with pytest.raises(InputError, match="must be float32 or float64"):
        decode_cloud(ros2.cloud(0, integers), HERE)


def test_too_few_bytes_are_damage():
    cloud = ros2.cloud(0, columns_of(5))
    cloud.data = cloud.data[:-1]
    with pytest.raises(DamagedMessageError, match=r"^a\.mcap: topic '/points' at 1\.000 s: the cloud holds 59 bytes"):
        decode_cloud(cloud, HERE)
