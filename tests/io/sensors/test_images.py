from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from log_factory import Factory, ros2
from octoreplay.errors import InputError
from octoreplay.io.containers.log_reader import DamagedMessageError
from octoreplay.io.sensors.images import DEPTH_ENCODINGS, LABEL_ENCODINGS, camera_model, decode_depth, decode_labels
from octoreplay.records import CameraModel

HERE = "a.mcap: topic '/x' at 1.000 s"


def pixels_of(kind: str, height: int, width: int) -> np.ndarray:
    count = height * width
    if kind == "f4":
        values = np.linspace(0.1, 9.9, count).astype("f4")
        values[0] = np.nan
        return values.reshape(height, width)
    limits = np.iinfo(kind)
    return np.linspace(limits.min, limits.max, count).astype(kind).reshape(height, width)


@given(st.sampled_from(sorted(DEPTH_ENCODINGS)), st.integers(1, 7), st.integers(1, 9), st.integers(0, 5), st.booleans())
def test_depth_comes_out_as_it_went_in(encoding, height, width, padding, big_endian):
    kind, unit = DEPTH_ENCODINGS[encoding]
    pixels = pixels_of(kind, height, width)
    message = ros2.image(0, pixels, encoding, padding=padding, big_endian=big_endian)
    image, found_unit = decode_depth(message, HERE)
    assert found_unit == unit
    assert image.dtype == np.dtype(kind)
    assert image.dtype.isnative
    assert image.flags.c_contiguous
    assert image.flags.aligned
    np.testing.assert_array_equal(image, pixels)


@given(st.sampled_from(sorted(LABEL_ENCODINGS)), st.integers(0, 5), st.booleans())
def test_labels_come_out_as_they_went_in(encoding, padding, big_endian):
    pixels = pixels_of(LABEL_ENCODINGS[encoding], 5, 6)
    message = ros2.image(0, pixels, encoding, padding=padding, big_endian=big_endian)
    labels = decode_labels(message, HERE)
    assert labels.dtype == pixels.dtype
    np.testing.assert_array_equal(labels, pixels)


def test_an_aligned_image_is_not_copied():
    message = ros2.image(0, pixels_of("u2", 4, 4), "16UC1")
    image, _ = decode_depth(message, HERE)
    assert np.shares_memory(image, message.data)


def test_unaligned_bytes_are_copied_to_aligned_ones():
    message = ros2.image(0, pixels_of("f4", 4, 4), "32FC1")
    expected = pixels_of("f4", 4, 4)
    shifted = np.zeros(len(message.data) + 1, np.uint8)
    shifted[1:] = message.data
    message.data = shifted[1:]
    image, _ = decode_depth(message, HERE)
    assert image.flags.aligned
    np.testing.assert_array_equal(image, expected)


def test_the_last_row_may_lack_its_padding():
    message = ros2.image(0, pixels_of("u2", 3, 4), "16UC1", padding=6)
    message.data = message.data[:-6]
    np.testing.assert_array_equal(decode_depth(message, HERE)[0], pixels_of("u2", 3, 4))
    message.data = message.data[:-1]
    with pytest.raises(DamagedMessageError, match=r"^a\.mcap: topic '/x' at 1\.000 s: the image holds 35 bytes, but 3"):
        decode_depth(message, HERE)


def test_other_encodings_are_refused_with_what_can_be_read():
    message = ros2.image(0, pixels_of("u1", 3, 4), "rgb8")
    with pytest.raises(InputError, match="'rgb8' holds no depth; 16UC1, mono16, 32FC1 can be read"):
        decode_depth(message, HERE)
    with pytest.raises(InputError, match="'rgb8' holds no labels; mono8, 8UC1"):
        decode_labels(message, HERE)


@pytest.mark.parametrize(("field", "value"), [("height", 0), ("width", 0), ("step", 7), ("height", 1000)])
def test_sizes_that_cannot_be_are_damage(field, value):
    message = ros2.image(0, pixels_of("u2", 3, 4), "16UC1")
    setattr(message, field, value)
    with pytest.raises(DamagedMessageError):
        decode_depth(message, HERE)


@pytest.mark.parametrize("ros1", [False, True])
def test_camera_model_is_k(ros1):
    factory = Factory(ros1=ros1)
    info = factory.camera_info(0, (64, 48), k=(70, 0, 31, 0, 71, 23, 0, 0, 1), d=(0.0,) * 5)
    assert camera_model(info, HERE) == CameraModel(64, 48, 70.0, 71.0, 31.0, 23.0)


def test_distortion_and_missing_calibration_are_refused():
    with pytest.raises(InputError, match=r"distortion \(model 'plumb_bob'\).*use a rectified depth image"):
        camera_model(ros2.camera_info(0, (64, 48), d=(0.0, 0.0, 0.01, 0, 0)), HERE)
    with pytest.raises(InputError, match=r"not calibrated .* give intrinsics"):
        camera_model(ros2.camera_info(0, (64, 48), k=(0,) * 9), HERE)
