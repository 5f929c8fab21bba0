"""The renderer's images: they agree with depth and poses, and effects do what they say."""

import cv2
import numpy as np
import pytest
from benchmarks.painting import paint_faces

from pliant.algorithms.arrays import F64
from pliant.algorithms.geometry import matrix_to_pose, so3_exp
from pliant.evaluation.visible_depth import DepthView
from pliant.rendering.face_textures import FaceTexture, make_face_colours
from pliant.rendering.film import CameraOptions, RenderedFrame
from pliant.rendering.lens import lens, pixel_rays
from pliant.rendering.paths import CameraPath, SampledPath
from pliant.rendering.photometry import exposure_gain, sensor_image
from pliant.rendering.render import Renderer, SceneGeometry
from pliant.rendering.scenes import SCENES
from pliant.rendering.textures import make_texture, shrink

CLEAN = CameraOptions(width=320, height=240, noise=0.0, exposure=0.0, blur=0.0)
TINY = SCENES["tiny"]()
EUROC = (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05)


@pytest.fixture(scope="module")
def painted() -> tuple[SceneGeometry, list[FaceTexture]]:
    geometry = SceneGeometry(TINY.scene)
    return geometry, paint_faces(geometry)


def film(
    painted: tuple[SceneGeometry, list[FaceTexture]],
    camera: CameraOptions,
    *times_s: float,
    path: CameraPath = TINY.path,
) -> list[RenderedFrame]:
    renderer = Renderer(*painted, path, camera)
    return [renderer.frame(round(time * 30.0), time) for time in times_s]


def bilinear(image: F64, points: F64) -> F64:
    col, row = np.floor(points).astype(int).T
    p, q = (points - np.floor(points)).T
    top = image[row, col] * (1 - p) + image[row, col + 1] * p
    bottom = image[row + 1, col] * (1 - p) + image[row + 1, col + 1] * p
    return top * (1 - q) + bottom * q


def difference(a: RenderedFrame, b: RenderedFrame, camera: CameraOptions) -> F64:
    """Grey values of b where depth and poses say that a's pixels are, less those of a."""
    v, u = np.mgrid[4 : camera.height - 4, 4 : camera.width - 4]
    points = np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float64)
    view_a, view_b = (
        DepthView.of(camera.pinhole(), frame.T_world_camera, frame.depth_m) for frame in (a, b)
    )
    surface, defined = view_a.lift(points)
    to, depths = view_b.project(surface)
    with np.errstate(invalid="ignore"):
        good = defined & view_b.visible(to, depths) & (to > 3.0).all(axis=1)
        good &= (to < (camera.width - 4, camera.height - 4)).all(axis=1)
    seen = bilinear(b.image.astype(np.float64), to[good])
    return seen - a.image[v.ravel()[good], u.ravel()[good]]


def test_reprojection_by_depth_and_pose_finds_the_same_grey_values(painted):
    a, b = film(painted, CLEAN, 0.1, 0.5)
    error = np.abs(difference(a, b, CLEAN))
    unmoved = np.abs(a.image.astype(float) - b.image)[4:-4, 4:-4]
    assert len(error) > 0.6 * unmoved.size
    assert np.median(unmoved) > 6.0
    assert np.median(error) < 1.5


def test_the_pose_is_that_of_the_middle_of_the_exposure(painted):
    """Turning one way or the other sweeps the same directions if the pose is in their middle."""
    wide = CLEAN.model_copy(update={"blur": 1.0})
    sharp = film(painted, CLEAN, 0.5, path=_turning_path(0.8))[0].image.astype(np.float64)
    left, right = (
        film(painted, wide, 0.5, path=_turning_path(speed))[0].image.astype(np.float64)
        for speed in (0.8, -0.8)
    )
    assert np.abs(sharp - left).mean() > 3.0  # some 7 px of blur
    slope = np.gradient(0.5 * (left + right), axis=1)
    shift_px = (slope * (left - right)).sum() / (slope**2).sum()
    assert abs(shift_px) < 0.1  # one sub-exposure is 1.2 px


def _turning_path(rad_per_s: float) -> SampledPath:
    T = TINY.path.T_world_camera(0.5)
    times = np.linspace(0.0, 1.0, 31)
    poses = np.repeat(T[None], 31, axis=0)
    turn = np.outer(rad_per_s * (times - 0.5), [0.0, 1.0, 0.0])
    poses[:, :3, :3] = poses[:, :3, :3] @ so3_exp(turn)
    return SampledPath(times, matrix_to_pose(poses))


def test_rectification_by_the_calibration_gives_the_pinhole_image_back(painted):
    bent = CLEAN.model_copy(update={"distortion": EUROC})
    pinhole, distorted = (film(painted, camera, 0.3)[0] for camera in (CLEAN, bent))
    assert np.abs(pinhole.image.astype(int) - distorted.image).mean() > 5.0
    camera = CLEAN.pinhole()
    v, u = np.mgrid[40:200, 40:280]
    rays = camera.normalise(np.stack([u.ravel(), v.ravel()], axis=1))
    source = lens(camera, EUROC).project(rays)
    rectified = bilinear(distorted.image.astype(np.float64), source)
    error = np.abs(rectified - pinhole.image[v.ravel(), u.ravel()])
    assert np.median(error) < 1.5
    # The depth is that of the rectified image, with or without a lens.
    np.testing.assert_array_equal(pinhole.depth_m, distorted.depth_m)


def test_distortion_and_its_inverse_cancel():
    rays = pixel_rays(CameraOptions(distortion=EUROC).pinhole(), EUROC)
    camera = CameraOptions().pinhole()
    back = lens(camera, EUROC).project(rays)
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    np.testing.assert_allclose(back, np.stack([u, v], axis=-1), atol=1e-6)


def test_a_lens_that_folds_the_image_is_refused():
    with pytest.raises(ValueError, match="folds the image"):
        pixel_rays(CLEAN.pinhole(), (-1.5, 0.0, 0.0, 0.0))


def test_noise_has_its_deviation_and_its_seed(painted):
    noisy = CLEAN.model_copy(update={"noise": 2.0})
    clean = film(painted, CLEAN, 0.2)[0].image.astype(float)
    first, again = (film(painted, noisy, 0.2)[0].image for _ in range(2))
    other = film(painted, noisy.model_copy(update={"seed": 1}), 0.2)[0].image
    np.testing.assert_array_equal(first, again)
    assert (first != other).mean() > 0.5
    # Two roundings add 1/6 to the variance.
    assert (first - clean).std() == pytest.approx(np.sqrt(4.0 + 1.0 / 6.0), rel=0.03)
    following = film(painted, noisy, 0.2, 0.2 + 1.0 / 30.0)[1].image
    assert (following != first).mean() > 0.5


def test_exposure_swings_by_the_given_amount():
    gains = np.array([exposure_gain(t, 0.2) for t in np.arange(0.0, 10.0, 1.0 / 30.0)])
    assert 0.17 < gains.max() - gains.min() <= 0.2
    assert np.abs(np.diff(gains)).max() < 0.01
    assert exposure_gain(1.0, 0.0) == 1.0


def test_the_sensor_saturates_and_rounds():
    light = np.array([[[-3.0], [10.4], [10.6], [300.0]]], np.float32)
    image = sensor_image(light, gain=1.0, noise=0.0, rng=np.random.default_rng(0))
    assert image.ravel().tolist() == [0, 10, 11, 255]


def test_the_grey_image_of_a_colour_image_is_the_grey_one(painted):
    camera = CameraOptions(width=320, height=240)  # with noise, blur and exposure
    geometry = painted[0]
    what = geometry.scene, geometry.solids
    colours = [make_face_colours(*what, face) for face in range(geometry.n_faces)]
    grey, rgb = (
        Renderer(*painted, TINY.path, camera, given).frame(6, 0.2).image
        for given in (None, colours)
    )
    np.testing.assert_array_equal(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), grey)
    assert np.ptp(rgb.astype(int), axis=2).mean() > 10.0
    # The globe is green, the ball on the book is red.
    red, green, _ = np.moveaxis(rgb.astype(int), 2, 0)
    assert (green - red > 30).mean() > 0.01
    assert (red - green > 40).mean() > 0.003


def test_frames_do_not_depend_on_their_order(painted):
    renderer = Renderer(*painted, TINY.path, CameraOptions(width=96, height=72))
    forward = [renderer.frame(i, i / 30.0).image for i in range(3)]
    backward = [renderer.frame(i, i / 30.0).image for i in reversed(range(3))]
    for a, b in zip(forward, reversed(backward), strict=True):
        np.testing.assert_array_equal(a, b)


def test_textures_have_structure_at_every_scale_and_do_not_repeat():
    material = TINY.scene.solids[3].material
    image = make_texture(np.random.default_rng(1), 512, 512, material)
    level, deviations = image, []
    while len(level) >= 16:
        coarse = shrink(level)
        deviations.append(float((level - np.kron(coarse, np.ones((2, 2)))).std()))
        level = coarse
    assert min(deviations) > 2.0
    assert max(deviations) < 6.0 * min(deviations)
    spectrum = np.abs(np.fft.fft2(image - image.mean())) ** 2
    correlation = np.real(np.fft.ifft2(spectrum))
    correlation /= correlation[0, 0]
    far = np.roll(correlation, (256, 256), axis=(0, 1))
    rows, cols = np.mgrid[-256:256, -256:256]
    assert np.abs(far[np.hypot(rows, cols) > 100]).max() < 0.35
