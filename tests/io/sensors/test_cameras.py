from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from octoreplay.errors import InputError
from octoreplay.io.messages.sensor_messages import Calibration, convert
from octoreplay.io.sensors.cameras import FISHEYE_MODELS, POLYNOMIAL_MODELS, camera_model
from octoreplay.records import CameraModel
from support.log_factory import Factory
from support.long_suite import examples

HERE = "a.mcap: topic '/camera_info' at 1.000 s"
K = (70.0, 0, 31, 0, 71, 23, 0, 0, 1)
P = (60.0, 0, 30, -6, 0, 61, 22, 0, 0, 0, 1, 0)


def calibration(*, ros1: bool = False, size=(64, 48), **fields) -> Calibration:
    info = Factory(ros1=ros1).camera_info(0, size, **{"k": K, **fields})
    return convert("sensor_msgs/msg/CameraInfo", info)


def polynomial(x, y, D):
    """Image-plane position of a ray: OpenCV's calib3d, with up to 12 coefficients."""
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = np.pad(D, (0, 12 - len(D)))
    r2 = x * x + y * y
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + s1 * r2 + s2 * r2**2,
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + s3 * r2 + s4 * r2**2,
    )


def fisheye(x, y, D):
    """The same for Kannala and Brandt's model as in OpenCV's fisheye module."""
    r = np.hypot(x, y)
    theta = np.arctan(r)
    scale = np.divide(
        theta * (1 + sum(k * theta ** (2 * i + 2) for i, k in enumerate(D))), r, where=r > 0, out=np.ones_like(r)
    )
    return x * scale, y * scale


# --- pinhole ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ros1", [False, True])
@pytest.mark.parametrize("is_rectified", [False, True])
def test_without_p_or_distortion_the_camera_is_k(ros1, is_rectified):
    model = camera_model(calibration(ros1=ros1, d=(0.0,) * 5), HERE, is_rectified=is_rectified)
    assert model == CameraModel(64, 48, 70.0, 71.0, 31.0, 23.0)
    assert model.slopes is None


@pytest.mark.parametrize("ros1", [False, True])
def test_a_rectified_image_uses_p_without_distortion(ros1):
    info = calibration(ros1=ros1, d=(0.3, 0.1, 0, 0, 0), p=P)
    model = camera_model(info, HERE, is_rectified=True)
    assert model == CameraModel(64, 48, 60.0, 61.0, 30.0, 22.0)
    assert model.slopes is None
    assert camera_model(dataclasses.replace(info, D=np.zeros(5)), HERE, is_rectified=False).fx == 70.0


def test_an_unknown_distortion_does_not_matter_where_the_image_is_rectified():
    info = calibration(d=(0.3,) * 7, model="unheard of", p=P)
    assert camera_model(info, HERE, is_rectified=True).fx == 60.0


@pytest.mark.parametrize(
    ("binning", "roi", "expected"),
    [
        # By hand: the region is cut out of the full image, then pixels are binned (image_geometry).
        ((2, 4), (0, 0, 0, 0), (32, 12, 35.0, 17.75, 15.5, 5.75)),
        ((0, 0), (10, 20, 30, 16), (30, 16, 70.0, 71.0, 21.0, 3.0)),
        ((2, 4), (10, 20, 30, 16), (15, 4, 35.0, 17.75, 10.5, 0.75)),
        ((1, 2), (3, 0, 33, 48), (33, 24, 70.0, 35.5, 28.0, 11.5)),
    ],
)
def test_binning_and_region_of_interest(binning, roi, expected):
    model = camera_model(calibration(binning=binning, roi=roi), HERE, is_rectified=False)
    assert dataclasses.astuple(model)[:6] == pytest.approx(expected)


def test_binning_and_region_of_interest_of_a_rectified_image():
    info = calibration(binning=(2, 4), roi=(10, 20, 30, 16), p=P)
    expected = (15, 4, 30.0, 15.25, 10.0, 0.5)
    assert dataclasses.astuple(camera_model(info, HERE, is_rectified=True))[:6] == pytest.approx(expected)


def test_a_distorting_lens_that_is_cut_and_binned_has_the_slopes_of_the_full_image_there():
    d = (-0.2, 0.05, 0.001, -0.002, 0.0)
    whole = camera_model(calibration(d=d), HERE, is_rectified=False).slopes
    part = camera_model(calibration(d=d, roi=(10, 20, 30, 16)), HERE, is_rectified=False).slopes
    np.testing.assert_allclose(part, whole[:, 20:36, 10:40], atol=1e-6)
    binned = camera_model(calibration(d=d, binning=(2, 2)), HERE, is_rectified=False).slopes
    np.testing.assert_allclose(binned, whole[:, ::2, ::2], atol=1e-6)


# --- lenses that distort ---------------------------------------------------------------------------------------------

small = st.floats(-1e-3, 1e-3)
polynomials = st.one_of(
    st.tuples(st.floats(-0.2, 0.2), st.floats(-0.02, 0.02), small, small),
    st.tuples(st.floats(-0.2, 0.2), st.floats(-0.02, 0.02), small, small, st.floats(-0.005, 0.005)),
    st.tuples(
        st.floats(0.5, 1.0), st.floats(0.0, 0.2), small, small, st.floats(0.0, 0.05),
        st.floats(0.5, 1.0), st.floats(0.0, 0.2), st.floats(0.0, 0.05),
    ),
    st.tuples(*[st.floats(-0.1, 0.1)] * 2, *[small] * 10),
)  # fmt: skip
slopes = st.tuples(st.floats(-0.8, 0.8), st.floats(-0.8, 0.8))


def check_round_trip(model_name: str, project, D, slope) -> None:
    """The pixel of a ray has the ray's slopes; K is chosen so that the ray falls on pixel (2, 1)."""
    a, b = project(np.array(slope[0]), np.array(slope[1]), D)
    k = (300.0, 0, 2 - 300.0 * float(a), 0, 310.0, 1 - 310.0 * float(b), 0, 0, 1)
    info = calibration(size=(5, 4), k=k, d=D, model=model_name)
    model = camera_model(info, HERE, is_rectified=False)
    if not any(D):
        assert model.slopes is None
        return
    assert model.slopes.shape == (2, 4, 5)
    assert model.slopes.dtype == np.float32
    assert model.slopes.flags.c_contiguous
    assert (model.width, model.height, model.fx, model.cy) == (5, 4, k[0], k[5])
    np.testing.assert_allclose(model.slopes[:, 1, 2], slope, atol=1e-5)


@given(st.sampled_from(POLYNOMIAL_MODELS), polynomials, slopes)
@examples(150)
def test_projected_rays_are_recovered(model_name, D, slope):
    check_round_trip(model_name, polynomial, D, slope)


@given(
    st.sampled_from(FISHEYE_MODELS), st.tuples(*[st.floats(-0.02, 0.02)] * 4),
    st.tuples(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0)),
)  # fmt: skip
@examples(150)
def test_projected_rays_are_recovered_from_a_fisheye(model_name, D, slope):
    theta = np.arctan(np.hypot(*slope))
    distorted = theta * (1 + sum(k * theta ** (2 * i + 2) for i, k in enumerate(D)))
    # The model has no inverse where the image folds.
    grows = all(
        1 + sum((2 * i + 3) * k * t ** (2 * i + 2) for i, k in enumerate(D)) > 0.3 for t in np.linspace(0, theta, 20)
    )
    if grows and distorted < 1.5:
        check_round_trip(model_name, fisheye, D, slope)


@pytest.mark.parametrize(
    ("model_name", "project", "d"),
    [
        ("plumb_bob", polynomial, (-0.28, 0.07, 0.0002, -0.0001, 0.0)),
        ("rational_polynomial", polynomial, (1.5, 0.4, 1e-4, -2e-4, 0.02, 1.8, 0.7, 0.08)),
        ("equidistant", fisheye, (0.02, -0.005, 0.001, -0.0002)),
    ],
)
def test_the_ray_of_every_pixel_projects_to_it(model_name, project, d):
    info = calibration(size=(64, 48), d=d, model=model_name)
    x, y = camera_model(info, HERE, is_rectified=False).slopes.astype(np.float64)
    columns, rows = np.meshgrid(np.arange(64), np.arange(48))
    a, b = project(x, y, d)
    np.testing.assert_allclose(70 * a + 31, columns, atol=1e-3)
    np.testing.assert_allclose(71 * b + 23, rows, atol=1e-3)


def test_pixels_that_no_ray_of_the_lens_model_hits_are_nan():
    """r (1 - 0.4 r^2) is at most 2/3 sqrt(1 / 1.2); beyond there are no rays, within the smaller root is the ray."""
    info = calibration(size=(64, 48), k=(40.0, 0, 31, 0, 40.0, 23, 0, 0, 1), d=(-0.4, 0, 0, 0, 0))
    model = camera_model(info, HERE, is_rectified=False)
    columns, rows = np.meshgrid(np.arange(64), np.arange(48))
    radius = np.hypot((columns - 31) / 40, (rows - 23) / 40)
    largest = 2 / 3 * np.sqrt(1 / 1.2)
    is_outside = radius > largest + 0.05 / 40 * np.sqrt(2) + 1e-6
    assert 0.1 < is_outside.mean() < 0.9
    assert np.isnan(model.slopes[:, is_outside]).all()
    is_inside = radius < 0.98 * largest
    assert np.isfinite(model.slopes[:, is_inside]).all()
    for r, slope in zip(radius[is_inside], np.hypot(*model.slopes[:, is_inside]), strict=True):
        roots = np.roots([-0.4, 0, 1, -r])
        assert slope == pytest.approx(
            min(root.real for root in roots if abs(root.imag) < 1e-9 and root.real >= -1e-9), abs=1e-5
        )


@given(
    st.tuples(st.floats(-0.5, 0.5), st.floats(-0.3, 0.3), st.floats(-0.2, 0.2)),
    st.just((0.0, 0.0, 0.0)) | st.tuples(st.floats(0.0, 0.5), st.floats(-0.3, 0.3), st.floats(-0.1, 0.2)),
)  # fmt: skip
@example((0.0, 0.0, 0.4), (1.0, 0.0, 0.4))
@example((0.3, 0.0, 0.0), (0.0, 0.0, 0.4))
@examples(60)
def test_a_pixel_has_the_ray_from_within_the_fold_or_none(above, below):
    """Compared with a table of the radial factor times r, from 0 up to its first decrease or pole."""
    D = (above[0], above[1], 0, 0, above[2], *below)
    info = calibration(size=(41, 1), k=(20.0, 0, 0, 0, 20.0, 0, 0, 0, 1), d=D, model="rational_polynomial")
    model = camera_model(info, HERE, is_rectified=False)
    if model.slopes is None:
        return
    r = np.linspace(0, 20, 200_001)
    denominator = 1 + below[0] * r**2 + below[1] * r**4 + below[2] * r**6
    with np.errstate(all="ignore"):
        image = r * (1 + above[0] * r**2 + above[1] * r**4 + above[2] * r**6) / denominator
        steps = np.diff(image)
    end = int(np.argmax(np.append((steps <= 0) | (denominator[1:] <= 0) | ~np.isfinite(steps), True)))
    expected = np.interp(np.arange(41) / 20, image[: end + 1], r[: end + 1], right=np.nan)
    found = model.slopes[0, 0]
    is_found = np.isfinite(found)
    assert np.nanmax(np.where(is_found, found, 0.0)) <= r[end] + 2e-4
    # Near the fold a small error in pixels is a large error in slope.
    is_steep = np.interp(expected, r[:-1], steps) > 0.2 * (r[1] - r[0])
    np.testing.assert_allclose(found[is_found & is_steep], expected[is_found & is_steep], atol=1e-3)
    assert is_found[is_steep & (expected < 0.6)].all()


def test_a_fisheye_of_more_than_half_a_turn_has_nan_at_its_rim():
    info = calibration(size=(64, 48), k=(15.0, 0, 31, 0, 15.0, 23, 0, 0, 1), d=(0.01, 0, 0, 0), model="equidistant")
    model = camera_model(info, HERE, is_rectified=False)
    columns, rows = np.meshgrid(np.arange(64), np.arange(48))
    radius = np.hypot((columns - 31) / 15, (rows - 23) / 15)
    half_pi = np.pi / 2
    assert np.isnan(model.slopes[:, radius > half_pi * (1 + 0.01 * half_pi**2) + 0.05 / 15]).all()
    assert np.isfinite(model.slopes[:, radius < 1.5]).all()


# --- what is refused -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("is_rectified", [False, True])
@pytest.mark.parametrize("k", [(0,) * 9, (70, 0, 31, 0, -1, 23, 0, 0, 1), (np.nan, 0, 31, 0, 70, 23, 0, 0, 1)])
def test_a_camera_without_calibration_is_refused(k, is_rectified):
    with pytest.raises(InputError, match=r"^a\.mcap: .*: the camera is not calibrated .* give intrinsics"):
        camera_model(calibration(k=k), HERE, is_rectified=is_rectified)


@pytest.mark.parametrize(
    ("model", "d"), [("unheard of", (0.1,) * 5), ("plumb_bob", (0.1,) * 3), ("equidistant", (0.1,) * 5), ("", (0.1,))]
)
def test_an_unknown_model_is_refused_with_the_known_ones(model, d):
    sentence = (
        rf"distortion of the model '{model}' with {len(d)} coefficients, which is not supported \(plumb_bob, "
        r"rational_polynomial, equidistant, fisheye, kannala_brandt are\); use a rectified depth image, or give intrin"
    )
    with pytest.raises(InputError, match=sentence):
        camera_model(calibration(d=d, model=model), HERE, is_rectified=False)


@pytest.mark.parametrize(
    "fields",
    [
        {"size": (2**32 - 1, 2**32 - 1)}, {"size": (0, 0)}, {"binning": (100, 100)}, {"binning": (2**32 - 1, 1)},
        {"roi": (0, 0, 2**32 - 1, 2**32 - 1)},
    ],
)  # fmt: skip
@pytest.mark.parametrize(("model", "d"), [("plumb_bob", (0.1, 0, 0, 0, 0)), ("equidistant", (0.1, 0, 0, 0))])
def test_impossible_sizes_are_refused_without_computing_rays(fields, model, d):
    with pytest.raises(InputError, match=r"the camera's image cannot be .* pixels; give intrinsics"):
        camera_model(calibration(d=d, model=model, **fields), HERE, is_rectified=False)


@given(
    st.sampled_from([("plumb_bob", 5), ("rational_polynomial", 8), ("plumb_bob", 14), ("equidistant", 4)]),
    st.data(),
)  # fmt: skip
@examples(100)
def test_any_coefficients_give_a_camera_or_an_error(kind, data):
    numbers = st.floats(width=32) | st.sampled_from([0.0, 1e300, -1e300, np.nan, np.inf])
    d = data.draw(st.tuples(*[numbers] * kind[1]))
    try:
        model = camera_model(calibration(size=(5, 4), d=d, model=kind[0]), HERE, is_rectified=False)
    except InputError:
        return
    assert model.slopes is None or model.slopes.shape == (2, 4, 5)
