"""Rectification against OpenCV's point functions, analytic images and finite differences."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.rectification import (
    MIN_CENTRAL_SCALE,
    Lens,
    distort,
    fold_radius,
    rectification_maps,
    rectified_camera,
    resample,
    source_pixels,
    undistort,
)

EUROC = Lens(
    model="pinhole-radtan",
    width=752,
    height=480,
    fx=458.654,
    fy=457.296,
    cx=367.215,
    cy=248.375,
    coefficients=(-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05, 0.0),
)
TUM_FR1 = Lens(
    model="pinhole-radtan",
    width=640,
    height=480,
    fx=517.306408,
    fy=516.469215,
    cx=318.64304,
    cy=255.313989,
    coefficients=(0.262383, -0.953104, -0.005358, 0.002628, 1.163314),
)
PINCUSHION = Lens(
    model="pinhole-radtan",
    width=320,
    height=240,
    fx=300.0,
    fy=310.0,
    cx=170.0,
    cy=115.0,
    coefficients=(0.3, 0.02, 0.002, -0.003, 0.0),
)
FISHEYE = Lens(
    model="fisheye",
    width=512,
    height=512,
    fx=190.978,
    fy=190.973,
    cx=254.932,
    cy=256.897,
    coefficients=(0.0034824, 0.00071503, -0.0020532, 0.00020294),
)
LENSES = {"euroc": EUROC, "tum_fr1": TUM_FR1, "pincushion": PINCUSHION, "fisheye": FISHEYE}


def intrinsics(lens: Lens) -> np.ndarray:
    return lens.pinhole.K


def scattered(lens: Lens, count: int = 400, margin: float = 5.0) -> np.ndarray:
    rng = np.random.default_rng(5)
    return rng.uniform(margin, np.array([lens.width, lens.height]) - 1.0 - margin, (count, 2))


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_project_is_opencvs(lens: Lens) -> None:
    points = rectified_camera(lens).normalise(scattered(lens))
    cubes = np.column_stack([points, np.ones(len(points))])[:, None]
    D = np.array(lens.coefficients)
    if lens.model == "fisheye":
        expected, _ = cv2.fisheye.projectPoints(
            cubes, np.zeros(3), np.zeros(3), intrinsics(lens), D
        )
    else:
        expected, _ = cv2.projectPoints(cubes, np.zeros(3), np.zeros(3), intrinsics(lens), D)
    np.testing.assert_allclose(lens.project(points), expected[:, 0], atol=1e-8)


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_undistort_is_the_inverse_and_opencvs(lens: Lens) -> None:
    points = rectified_camera(lens).normalise(scattered(lens))
    back = undistort(distort(points, lens), lens)
    np.testing.assert_allclose(back, points, atol=1e-8)
    pixels = lens.project(points)[:, None]
    D = np.array(lens.coefficients)
    if lens.model == "fisheye":
        expected = cv2.fisheye.undistortPoints(pixels, intrinsics(lens), D)
    else:
        # The few iterations that OpenCV makes by default are not enough.
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)
        expected = cv2.undistortPoints(pixels, intrinsics(lens), D, criteria=criteria)
    np.testing.assert_allclose(back, expected[:, 0], atol=1e-6)


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_maps_are_opencvs(lens: Lens) -> None:
    camera = rectified_camera(lens)
    size = (lens.width, lens.height)
    module = cv2.fisheye if lens.model == "fisheye" else cv2
    map_u, map_v = module.initUndistortRectifyMap(
        intrinsics(lens), np.array(lens.coefficients), np.eye(3), camera.K, size, cv2.CV_32FC1
    )
    np.testing.assert_allclose(source_pixels(lens, camera), np.dstack([map_u, map_v]), atol=2e-4)


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_resampled_points_are_where_the_model_puts_them(lens: Lens) -> None:
    """Coordinates that are drawn into the source image are read out of the rectified one."""
    camera = rectified_camera(lens)
    maps = rectification_maps(lens, camera)
    u, v = np.meshgrid(np.arange(lens.width), np.arange(lens.height))
    expected = source_pixels(lens, camera)
    for axis, ramp in enumerate((u, v)):
        # Eight bits hold a ramp of 32 pixels with 1/8 pixel a step: the rest by its period.
        image = ((ramp % 32) * 8).astype(np.uint8)
        got = resample(image, maps) / 8.0
        wanted = expected[..., axis]
        inner = (wanted % 32 > 1) & (wanted % 32 < 30)
        error = got[inner] - (wanted % 32)[inner]
        # 1/16 pixel is the rounding of the image to whole grey values, not of the maps.
        assert np.abs(error).max() < 1.0 / 16.0 + 0.02
    whole, fraction = maps
    found = whole + np.stack([fraction % 32, fraction // 32], axis=-1) / 32.0
    assert np.abs(found - expected).max() <= 1.0 / 64.0 + 1e-3
    assert np.abs((found - expected).mean(axis=(0, 1))).max() < 1e-3


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_blob_is_found_where_a_pinhole_camera_sees_it(lens: Lens) -> None:
    """Points drawn through the lens as smooth blobs come out at their pinhole projection."""
    camera = rectified_camera(lens)
    rows, columns = np.meshgrid(
        np.linspace(60, lens.height - 60, 4), np.linspace(60, lens.width - 60, 5)
    )
    targets = np.stack([columns.ravel(), rows.ravel()], axis=1)
    u, v = np.meshgrid(np.arange(float(lens.width)), np.arange(float(lens.height)))
    # Blobs are round in the rectified image, so they are drawn through the inverse of the lens.
    grid = undistort(np.dstack([(u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy]), lens)
    seen = grid * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    image = np.zeros((lens.height, lens.width))
    for target in targets:
        square = np.nan_to_num(((seen - target) ** 2).sum(axis=-1), nan=1e9)
        image += 250.0 * np.exp(-square / (2.0 * 4.0**2))
    rectified = resample(np.rint(image).astype(np.uint8), rectification_maps(lens, camera))
    for u0, v0 in targets:
        r, c = round(v0) - 15, round(u0) - 15
        patch = rectified[r : r + 31, c : c + 31].astype(np.float64)
        rr, cc = np.mgrid[r : r + 31, c : c + 31]
        found = np.array([(cc * patch).sum(), (rr * patch).sum()]) / patch.sum()
        assert np.abs(found - (u0, v0)).max() < 0.05


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_rectified_camera_sees_only_what_is_there_and_no_less(lens: Lens) -> None:
    camera = rectified_camera(lens)
    assert (camera.width, camera.height) == (lens.width, lens.height)
    assert camera.fx == camera.fy
    limits = np.array([lens.width, lens.height]) - 1.0
    source = source_pixels(lens, camera)
    assert source.min() >= 0.0
    assert np.all(source <= limits)
    scale = camera.fx / max(lens.fx, lens.fy)
    assert MIN_CENTRAL_SCALE <= scale < 1.3
    if scale > MIN_CENTRAL_SCALE:  # then some pixel touches the border
        assert min(source.min(), (limits - source).min()) < 0.01
    centre = source[
        lens.height // 2 - 1 : lens.height // 2 + 1, lens.width // 2 - 1 : lens.width // 2 + 1
    ]
    np.testing.assert_allclose(centre.mean(axis=(0, 1)), limits / 2.0, atol=0.01)


def test_without_distortion_nothing_changes() -> None:
    lens = Lens(model="pinhole-radtan", width=64, height=48, fx=50, fy=51, cx=30, cy=20,
                coefficients=(0.0,) * 5)  # fmt: skip
    assert not lens.distorts
    assert rectified_camera(lens) == PinholeCamera(width=64, height=48, fx=50, fy=51, cx=30, cy=20)
    points = np.array([[0.1, -0.2]])
    np.testing.assert_array_equal(distort(points, lens), points)
    np.testing.assert_array_equal(undistort(points, lens), points)
    assert fold_radius(lens) == np.inf


def test_fisheye_without_coefficients_is_equidistant() -> None:
    lens = Lens(model="fisheye", width=64, height=48, fx=30, fy=30, cx=31, cy=24,
                coefficients=(0.0,) * 4)  # fmt: skip
    assert lens.distorts
    np.testing.assert_allclose(
        distort(np.array([[1.0, 0.0], [0.0, 0.0]]), lens), [[np.pi / 4, 0], [0, 0]]
    )


def test_points_past_the_fold_have_no_inverse() -> None:
    lens = Lens(model="pinhole-radtan", width=640, height=480, fx=500, fy=500, cx=320, cy=240,
                coefficients=(-0.3, 0.0, 0.0, 0.0, 0.0))  # fmt: skip
    fold = 1.0 / np.sqrt(0.9)
    assert fold_radius(lens) == pytest.approx(fold, abs=2e-3)
    drawn_at_most = fold * (1.0 - 0.3 * fold**2)
    inside, outside = undistort(
        np.array([[0.98 * drawn_at_most, 0.0], [1.02 * drawn_at_most, 0.0]]), lens
    )
    assert 0.0 < inside[0] < fold
    assert np.all(np.isnan(outside))


def test_impossible_distortion_is_refused() -> None:
    lens = Lens(model="pinhole-radtan", width=640, height=480, fx=500, fy=500, cx=320, cy=240,
                coefficients=(-300.0, 0.0, 0.0, 0.0, 0.0))  # fmt: skip
    with pytest.raises(ValueError, match="fourth of the view"):
        rectified_camera(lens)


@settings(max_examples=30)
@given(
    k1=st.floats(-0.35, 0.3),
    k2=st.floats(-0.05, 0.1),
    p1=st.floats(-0.003, 0.003),
    p2=st.floats(-0.003, 0.003),
    cx=st.floats(130.0, 190.0),
    fisheye=st.booleans(),
)
def test_every_moderate_lens_is_rectified_within_its_image(
    k1: float, k2: float, p1: float, p2: float, cx: float, fisheye: bool
) -> None:
    lens = Lens(
        model="fisheye" if fisheye else "pinhole-radtan",
        width=320,
        height=240,
        fx=250.0,
        fy=251.0,
        cx=cx,
        cy=118.0,
        coefficients=(k1 / 10, k2 / 10, p1, p2) if fisheye else (k1, k2, p1, p2, 0.0),
    )
    camera = rectified_camera(lens)
    source = source_pixels(lens, camera)
    assert source.min() >= -1e-6
    assert np.all(source <= np.array([319.0, 239.0]) + 1e-6)
    # Neighbours stay neighbours, in order: nothing is folded.
    assert np.diff(source[..., 0], axis=1).min() > 0.0
    assert np.diff(source[..., 1], axis=0).min() > 0.0
    points = camera.normalise(scattered(lens, 50, 0.0))
    np.testing.assert_allclose(undistort(distort(points, lens), lens), points, atol=1e-7)


def test_colour_channels_are_resampled_alike() -> None:
    rng = np.random.default_rng(1)
    grey = rng.integers(0, 256, (240, 320), np.uint8)
    maps = rectification_maps(PINCUSHION, rectified_camera(PINCUSHION))
    colour = resample(np.dstack([grey, grey, grey]), maps)
    np.testing.assert_array_equal(colour, np.repeat(resample(grey, maps)[..., None], 3, axis=2))
