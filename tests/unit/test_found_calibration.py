"""The calibration that a run leaves, and what is said of it."""

import math

import numpy as np
import pytest

from pliant.algorithms.geometry import matrix_to_pose, so3_exp
from pliant.algorithms.rectification import rectified_camera
from pliant.algorithms.slam.calibration.corrected_view import corrected_view
from pliant.datasets.calibration import (
    Calibration,
    calibration_from_fov,
    calibration_from_yaml,
    calibration_yaml,
)
from pliant.messages.types import CameraStream
from pliant.results.calibration import (
    calibration_doubt,
    calibration_verdict,
    found_calibration,
)
from pliant.results.run import Run

PINHOLE = Calibration(model="pinhole", width=640, height=480, fx=520, fy=510, cx=310, cy=250)
RADTAN = Calibration(
    model="pinhole-radtan", width=640, height=480, fx=520, fy=510, cx=310, cy=250,
    distortion=(-0.2, 0.05, 0.001, -0.002, 0.0),
)  # fmt: skip
FISHEYE = Calibration(
    model="fisheye", width=640, height=480, fx=300, fy=300, cx=320, cy=240,
    distortion=(0.02, -0.01, 0.002, 0.0),
)  # fmt: skip


def run_with(given, correction, sigmas, *, source_size=(0, 0)):
    camera = rectified_camera(given.lens)
    run = Run()
    run.stream = CameraStream(
        frame=0, stamp_ns=0, frame_id="camera", source="s", mode="lossless", frames=1,
        calibration=calibration_yaml(given), width=camera.width, height=camera.height,
        fx=camera.fx, fy=camera.fy, cx=camera.cx, cy=camera.cy, focal_sigma=given.focal_sigma,
        source_width=source_size[0], source_height=source_size[1],
    )  # fmt: skip
    run.corrections[0], run.calibration_sigmas = correction, sigmas
    return run


@pytest.mark.parametrize("given", [PINHOLE, RADTAN, FISHEYE])
@pytest.mark.parametrize("correction", [(0.1, 0.0, 0.0, 0.2), (-0.05, 0.02, -0.01, 0.0)])
def test_the_found_camera_sees_what_the_images_show(given, correction):
    found = found_calibration(run_with(given, correction, (1e-3,) * 4))
    camera = rectified_camera(given.lens)
    u, v = np.meshgrid(np.linspace(40.0, 600.0, 9), np.linspace(40.0, 440.0, 9))
    px = np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float32)
    view = corrected_view(camera, correction)
    plane = view.camera.normalise(view.pixels(px).astype(np.float64))
    shown = given.lens.project(camera.normalise(px.astype(np.float64)))
    assert np.abs(found.lens.project(plane) - shown).max() < 0.5  # px
    assert calibration_from_yaml(calibration_yaml(found)) == found


def test_it_is_for_the_images_of_the_source_also_where_they_were_made_smaller():
    run = run_with(PINHOLE, (0.0, 0.0, 0.0, 0.0), (1e-3,) * 4, source_size=(1280, 960))
    found = found_calibration(run)
    assert (found.width, found.height, found.fx) == (1280, 960, 1040.0)


def test_what_is_open_stays_a_guess_for_the_next_run():
    guess = calibration_from_fov(640, 480, 60.0)
    assert found_calibration(run_with(guess, (0.2, 0.0, 0.0, 0.0), (0.004,) * 4)).focal_sigma == 0.0
    open_still = found_calibration(run_with(guess, (0.2, 0.0, 0.0, 0.0), (0.09,) * 4))
    assert open_still.focal_sigma == pytest.approx(math.hypot(0.09, 0.007))
    # Of a wrong one the map is bent: what it found is but nearer.
    nearer = found_calibration(run_with(PINHOLE, (0.16, 0.0, 0.0, 0.0), (0.004,) * 4))
    assert nearer.focal_sigma == pytest.approx(0.16)


def path(turn_rad, step):
    poses = {}
    for k in range(20):
        T = np.eye(4)
        T[:3, :3] = so3_exp(np.array([0.0, turn_rad * k / 19, 0.0]))
        T[:3, 3] = np.array(step) * k
        poses[k] = (0, matrix_to_pose(T))
    return poses


def test_one_line_has_the_estimate_or_why_it_is_open():
    guess = calibration_from_fov(640, 480, 60.0)
    ahead, round_about = path(0.1, (0.0, 0.0, 1.0)), path(1.0, (1.0, 0.0, 0.0))
    found = calibration_verdict(run_with(guess, (0.1, 0.0, 0.0, 0.0), (0.004,) * 4), round_about)
    assert found.startswith("estimated focal length")
    assert "+-0.8 %" in found
    unknown = calibration_verdict(run_with(guess, (0.1, 0.0, 0.0, 0.0), (0.09,) * 4), ahead)
    assert "unknown focal length" in unknown
    assert "moves straight ahead and it rotates by only 6 degrees" in unknown


def test_a_calibration_that_the_images_contradict_is_reported_with_the_error():
    correction = (math.log(1.2), 0.0, 0.0, 0.0)
    told = calibration_verdict(run_with(PINHOLE, correction, (0.003,) * 4), {})
    assert "contradict" in told
    assert "1.200 times the given one (+-0.8 %)" in told
    assert not calibration_verdict(run_with(PINHOLE, (0.008, 0.004, 0.0, 0.0), (1e-3,) * 4), {})
    assert not calibration_verdict(run_with(PINHOLE, correction, (0.2,) * 4), {})


def test_a_contradicted_principal_point_is_reported_and_doubtful_if_far_off():
    near, off, far = ((0.0, 0.0, 0.0, 0.0, a, -0.01) for a in (0.02, 0.04, 0.06))
    assert not calibration_verdict(run_with(PINHOLE, near, (1e-3,) * 6), {})
    run = run_with(PINHOLE, off, (1e-3,) * 6)
    assert "principal point +21, -5 px" in calibration_verdict(run, {})
    assert not calibration_doubt(run, {})
    doubt = calibration_doubt(run_with(PINHOLE, far, (1e-3,) * 6), {})
    assert "principal point +31, -5 px" in doubt
    assert found_calibration(run).cx == pytest.approx(310.0 + 0.04 * 520.0)


def test_pixels_that_are_not_square_are_reported_and_far_from_square_are_a_doubt():
    near, off, far = ((0.0, 0.0, 0.0, 0.0, 0.0, 0.0, t) for t in (0.006, -0.02, 0.05))
    assert not calibration_verdict(run_with(PINHOLE, near, (1e-3,) * 7), {})
    run = run_with(PINHOLE, off, (1e-3,) * 7)
    assert "fy / fx 0.980 times the given one" in calibration_verdict(run, {})
    assert not calibration_doubt(run, {})
    doubt = calibration_doubt(run_with(PINHOLE, far, (1e-3,) * 7), {})
    assert "fy / fx 1.051 times the given one" in doubt
    found = found_calibration(run)
    assert found.fx == pytest.approx(520.0)
    assert found.fy == pytest.approx(510.0 * math.exp(-0.02))


def test_what_bends_the_map_is_a_doubt_and_what_was_corrected_is_none():
    guess = calibration_from_fov(640, 480, 60.0)
    open_still = run_with(guess, (0.1, 0.0, 0.0, 0.0), (0.09,) * 4)
    assert calibration_doubt(open_still, {}).startswith("unknown focal length")
    assert not calibration_doubt(run_with(guess, (0.1, 0.0, 0.0, 0.0), (0.004,) * 4), {})
    far = run_with(PINHOLE, (math.log(0.89), 0.12, 0.0, 0.0), (0.003,) * 4)
    assert "focal length 0.890 times the given one" in calibration_doubt(far, {})
    assert not calibration_doubt(run_with(PINHOLE, (0.05, 0.0, 0.0, 0.0), (0.003,) * 4), {})
    assert not calibration_doubt(run_with(PINHOLE, (0.0, 0.0, 0.0, 0.0), (0.003,) * 4), {})
    assert not calibration_doubt(Run(), {})


def test_a_lens_that_no_calibration_can_have_leaves_the_focal_length():
    found = found_calibration(run_with(PINHOLE, (0.1, -30.0, 0.0, 0.0), (1e-3,) * 4))
    assert found.model == "pinhole"
    assert found.fx == pytest.approx(520.0 * math.exp(0.1))
