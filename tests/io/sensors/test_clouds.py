from __future__ import annotations

import dataclasses
import math
import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from octoreplay.errors import InputError
from octoreplay.io.messages.decoders import DamagedMessageError
from octoreplay.io.messages.sensor_messages import Cloud, CloudField, Scan, convert
from octoreplay.io.sensors.clouds import decode_cloud, decode_scan, label_field
from support.log_factory import Factory, ros2
from support.long_suite import examples

HERE = "a.mcap: topic '/points' at 1.000 s"
KINDS = ["i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"]


def columns_of(num: int, kind: str = "f4", **more: np.ndarray) -> dict[str, np.ndarray]:
    values = np.arange(1, 3 * num + 1, dtype=kind).reshape(num, 3)
    values = values / 4 if kind[0] == "f" else values
    return {"x": values[:, 0], "y": values[:, 1], "z": values[:, 2], **more}


def cloud_of(columns, *, factory: Factory = ros2, **options) -> Cloud:
    return convert("sensor_msgs/msg/PointCloud2", factory.cloud(0, columns, **options))


def with_field(cloud: Cloud, name: str, **changes) -> Cloud:
    fields = tuple(dataclasses.replace(f, **changes) if f.name == name else f for f in cloud.fields)
    return dataclasses.replace(cloud, fields=fields)


@examples(100)
@given(
    st.integers(1, 4), st.integers(1, 5), st.sampled_from(KINDS), st.integers(0, 5), st.integers(0, 9),
    st.booleans(), st.sampled_from(KINDS), st.permutations(["x", "y", "z", "intensity", "label", "confidence"]),
    st.booleans(),
)  # fmt: skip
def test_points_and_labels_are_decoded_exactly(height, width, kind, gap, padding, big_endian, label_kind, order, ros1):
    num = height * width
    labels = (np.arange(num) % 100).astype(label_kind)
    sure = (np.arange(num) % 256).astype("u1")
    columns = columns_of(num, kind, intensity=np.ones(num, "f4"), label=labels, confidence=sure)
    cloud = cloud_of(
        {name: columns[name] for name in order}, gap=gap, height=height, row_padding=padding, big_endian=big_endian,
        factory=Factory(ros1=ros1),
    )  # fmt: skip
    found = decode_cloud(cloud, HERE)
    assert found.points.dtype == (np.float32 if kind == "f4" else np.float64)
    assert found.points.dtype.isnative
    assert found.points.flags.c_contiguous
    np.testing.assert_array_equal(found.points, np.stack([columns["x"], columns["y"], columns["z"]], axis=1))
    assert found.labels.dtype == np.int64
    np.testing.assert_array_equal(found.labels, labels)
    assert found.confidences.dtype == np.uint8
    np.testing.assert_array_equal(found.confidences, sure)


def test_coordinates_of_mixed_types_are_wide():
    columns = {"x": np.array([1.5], "f4"), "y": np.array([0.1], "f8"), "z": np.array([-3], "i2")}
    points = decode_cloud(cloud_of(columns), HERE).points
    assert points.dtype == np.float64
    assert points.tolist() == [[1.5, 0.1, -3.0]]


def test_points_that_are_not_finite_or_at_the_sensor_are_left_out_with_their_fields():
    columns = columns_of(5, label=np.array([5, 6, 7, 8, 9], "u2"), prob=np.array([0, 0.2, 0.4, 0.6, 1], "f4"))
    columns = {name: column.copy() for name, column in columns.items()}
    columns["y"][1], columns["y"][2] = np.nan, np.inf
    for name in "xyz":
        columns[name][4] = 0.0
    found = decode_cloud(cloud_of(columns), HERE)
    assert found.points.shape == (2, 3)
    assert found.labels.tolist() == [5, 8]
    assert found.confidences.tolist() == [0, 153]


def test_a_cloud_without_labels_and_one_without_points():
    found = decode_cloud(cloud_of(columns_of(3)), HERE)
    assert label_field("xyz") is None
    assert found.labels is None
    assert found.confidences is None
    full = cloud_of(columns_of(2, label=np.zeros(2, "u1")))
    for empty in (
        dataclasses.replace(full, width=0, row_step=0, data=b""), dataclasses.replace(full, height=0, data=b""),
    ):  # fmt: skip
        found = decode_cloud(empty, HERE)
        assert found.points.shape == (0, 3)
        assert found.labels.shape == (0,)


def test_the_first_known_label_field_is_used_unless_another_is_wanted():
    assert label_field(["x", "class_id", "semantic"]) == "semantic"
    assert label_field(["x", "class_id", "semantic"], "x") == "x"
    assert label_field(["class_id"], "semantic") is None
    num = np.ones(1, "u1")
    cloud = cloud_of(
        columns_of(1, class_id=4 * num, semantic=5 * num, other=6 * num, conf=7 * num, probability=8 * num)
    )
    found = decode_cloud(cloud, HERE)
    assert (found.labels.tolist(), found.confidences.tolist()) == ([5], [8])
    found = decode_cloud(cloud, HERE, wanted_labels="other", wanted_confidences="conf")
    assert (found.labels.tolist(), found.confidences.tolist()) == ([6], [7])


@pytest.mark.parametrize("wanted", ["wanted_labels", "wanted_confidences"])
def test_a_wanted_field_must_exist(wanted):
    with pytest.raises(InputError, match=r"^a\.mcap: .* no usable field 'kind'; its fields are x, y, z, label"):
        decode_cloud(cloud_of(columns_of(1, label=np.ones(1, "u1"))), HERE, **{wanted: "kind"})


def test_labels_that_are_nan_or_out_of_range_are_minus_one():
    odd = np.array([np.nan, 3, np.inf, -np.inf, 1e30, -2], "f4")
    assert decode_cloud(cloud_of(columns_of(6, label=odd)), HERE).labels.tolist() == [-1, 3, -1, -1, -1, -2]
    assert decode_cloud(cloud_of(columns_of(1, label=np.array([1e300]))), HERE).labels.tolist() == [-1]


def test_confidences_are_255ths():
    values = np.array([0, 0.5, 1, 2, np.nan, -1], "f4")
    columns = columns_of(6, confidence=values)
    assert decode_cloud(cloud_of(columns), HERE).confidences.tolist() == [0, 128, 255, 255, 0, 0]
    columns = columns_of(3, confidence=np.array([0, 32768, 65535], "u2"))
    assert decode_cloud(cloud_of(columns, big_endian=True), HERE).confidences.tolist() == [0, 128, 255]


@pytest.mark.parametrize("name", ["rgb", "rgba", "semantic_color"])
@pytest.mark.parametrize("kind", ["f4", "u4", "i4"])
@pytest.mark.parametrize("big_endian", [False, True])
@pytest.mark.parametrize("gap", [0, 3])
def test_packed_colours_are_unpacked_as_pcl_packs_them(name, kind, big_endian, gap):
    """PCL: a << 24 | r << 16 | g << 8 | b, as an integer or as the bits of a float."""
    red, green, blue, alpha = (np.array(c, np.uint32) for c in ([1, 250], [2, 128], [3, 0], [255, 0x7F]))
    packed = (alpha << 24 | red << 16 | green << 8 | blue).view(kind)
    cloud = cloud_of(columns_of(2, **{name: packed}), big_endian=big_endian, gap=gap)
    found = decode_cloud(cloud, HERE, wanted_labels=name)
    assert found.labels.dtype == np.uint8
    assert found.labels.tolist() == [[1, 2, 3], [250, 128, 0]]


def test_colours_are_labels_only_where_wanted_or_so_named():
    packed = np.array([0x010203], "u4")
    assert decode_cloud(cloud_of(columns_of(1, rgb=packed)), HERE).labels is None
    assert decode_cloud(cloud_of(columns_of(1, semantic_color=packed)), HERE).labels.tolist() == [[1, 2, 3]]
    with pytest.raises(InputError, match="'rgb' packs colours and must have four bytes"):
        decode_cloud(cloud_of(columns_of(1, rgb=packed.astype("u2"))), HERE, wanted_labels="rgb")


def test_missing_and_odd_coordinates_are_refused():
    columns = columns_of(2)
    del columns["z"]
    with pytest.raises(InputError, match="no usable field 'z'; its fields are x, y"):
        decode_cloud(cloud_of(columns), HERE)
    for changes in ({"kind": ""}, {"count": 3}):
        with pytest.raises(InputError, match="no usable field 'y'; its fields are x, y, z"):
            decode_cloud(with_field(cloud_of(columns_of(2)), "y", **changes), HERE)


def test_an_unusable_field_is_ignored_unless_it_is_wanted():
    cloud = with_field(cloud_of(columns_of(2, label=np.ones(2, "u4"), prob=np.ones(2, "u1"))), "label", count=2)
    cloud = with_field(cloud, "prob", kind="")
    found = decode_cloud(cloud, HERE)
    assert (found.labels, found.confidences) == (None, None)
    with pytest.raises(InputError, match="no usable field 'label'"):
        decode_cloud(cloud, HERE, wanted_labels="label")


def test_too_few_bytes_are_damage():
    cloud = cloud_of(columns_of(5))
    with pytest.raises(DamagedMessageError, match=r"^a\.mcap: topic '/points' at 1\.000 s: the cloud holds 59 bytes"):
        decode_cloud(dataclasses.replace(cloud, data=cloud.data[:-1]), HERE)


def test_the_last_row_may_lack_its_padding():
    cloud = cloud_of(columns_of(6), height=2, row_padding=5)
    short = dataclasses.replace(cloud, data=cloud.data[:-5])
    np.testing.assert_array_equal(decode_cloud(short, HERE).points, decode_cloud(cloud, HERE).points)


HUGE = 2**32 - 1


@pytest.mark.parametrize(
    "changes",
    [
        {"point_step": 0}, {"point_step": 0, "row_step": 0},
        {"point_step": 0, "row_step": 0, "width": HUGE, "height": HUGE},
        {"point_step": 11}, {"point_step": HUGE}, {"width": HUGE}, {"height": HUGE}, {"width": HUGE, "height": HUGE},
        {"row_step": HUGE}, {"row_step": 1, "height": 20_000, "width": 4_000},
        {"row_step": 1, "height": 40_000, "width": 1},
    ],
)  # fmt: skip
def test_impossible_sizes_are_damage_and_take_no_memory(changes):
    cloud = cloud_of(columns_of(6000), height=2)
    tracemalloc.start()
    with pytest.raises(DamagedMessageError, match=r"^a\.mcap: .* are expected"):
        decode_cloud(dataclasses.replace(cloud, **changes), HERE)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1_000_000


@pytest.mark.parametrize("offset", [9, 12, HUGE])
def test_a_field_outside_its_point_is_damage(offset):
    with pytest.raises(DamagedMessageError):
        decode_cloud(with_field(cloud_of(columns_of(3)), "y", offset=offset), HERE)


sizes = st.integers(0, 5) | st.integers(0, 40) | st.sampled_from([HUGE, 1 << 31, 10**6])


@given(
    st.binary(max_size=300), sizes, sizes, sizes, sizes, st.booleans(),
    st.lists(st.tuples(st.sampled_from(["x", "y", "z", "label", "rgb", "prob"]), sizes, st.sampled_from(["", *KINDS]),
                       st.integers(1, 2)), max_size=7),
)  # fmt: skip
@settings(max_examples=400)
def test_any_cloud_gives_points_or_an_error(data, height, width, point_step, row_step, big_endian, fields):
    fields = tuple(CloudField(*field) for field in fields)
    for wanted in (None, "rgb"):
        cloud = Cloud(0, "", height, width, fields, big_endian, point_step, row_step, data)
        try:
            found = decode_cloud(cloud, HERE, wanted_labels=wanted)
        except InputError:
            continue
        assert len(found.points) <= len(data)
        for part in (found.labels, found.confidences):
            assert part is None or len(part) == len(found.points)


# --- scans -----------------------------------------------------------------------------------------------------------


def scan_of(ranges, **fields) -> Scan:
    values = {"angle_min": 0.0, "angle_increment": math.pi / 2, "range_min": 0.5, "range_max": 10.0}
    return Scan(0, "laser", **{**values, **fields}, ranges=np.array(ranges, float))


def test_a_scan_lies_in_the_plane_counter_clockwise_from_x():
    found = decode_scan(scan_of([1, 2, 3, 4], angle_min=-math.pi / 2))
    np.testing.assert_allclose(found.points, [[0, -1, 0], [2, 0, 0], [0, 3, 0], [-4, 0, 0]], atol=1e-12)
    assert (found.labels, found.confidences) == (None, None)


def test_ranges_that_carry_no_information_are_left_out():
    ranges = [np.nan, 0.49, 0.5, np.inf, 10.0, 10.1, -np.inf, -3, 0.0]
    found = decode_scan(scan_of(ranges, angle_increment=0.0))
    np.testing.assert_array_equal(found.points, [[0.5, 0, 0], [10, 0, 0]])
    # Without a limit, a range of 0 is no point either.
    found = decode_scan(scan_of([0.0, -1.0, 1e-3, np.inf], angle_increment=0.0, range_min=0.0, range_max=math.inf))
    np.testing.assert_array_equal(found.points, [[1e-3, 0, 0]])
    assert decode_scan(scan_of([1.0], range_max=np.nan)).points.shape == (0, 3)
    assert decode_scan(scan_of([])).points.shape == (0, 3)


def test_a_recorded_range_limit_includes_itself():
    """Limit and range are float32 in the message, so that the comparison is exact."""
    scan = convert("sensor_msgs/msg/LaserScan", ros2.scan(0, [0.1, 0.7], limits=(0.1, 0.7)))
    assert len(decode_scan(scan).points) == 2


def test_clouds_of_more_points_than_memory_are_refused():
    """Points of one byte: a compressed chunk of zeros expands by a factor of hundreds."""
    fields = tuple(CloudField(name, 0, "u1") for name in "xyz")
    size = (1 << 26) + 1
    cloud = Cloud(5, "lidar", 1, size, fields, False, 1, size, bytes(size))
    with pytest.raises(InputError, match="a cloud of 67108865 points is too large"):
        decode_cloud(cloud, HERE)
