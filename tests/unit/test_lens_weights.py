"""How much less observations count far from the axis, with the lens held and with it adjusted."""

import numpy as np
import pytest

from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.slam.active.active_map import ActiveMap
from pliant.algorithms.slam.adjust.final_adjustment import list_observations
from pliant.algorithms.slam.adjust.segment import Segment
from pliant.algorithms.slam.calibration.self_calibration import SelfCalibration
from pliant.algorithms.slam.estimate.observation_table import weigh
from pliant.algorithms.slam.estimate.problem import CalibrationUncertainty
from pliant.algorithms.slam.map.keyframe import Keyframe
from pliant.algorithms.slam.map.landmarks import Landmarks
from pliant.algorithms.slam.parameters import MappingParameters

CAMERA = PinholeCamera(width=640, height=480, fx=320.0, fy=320.0, cx=320.0, cy=240.0)
"""Its left border lies at -1 on the plane z = 1."""
UNKNOWN = CalibrationUncertainty(focal=0.3, k1=0.1, k2=0.1)
AXIS_HALF_BORDER = np.array([(320, 240), (160, 240), (0, 240)], np.float32)


def found(sigma: float, k1_sigma: float):
    """A covariance of the calibration."""
    return np.diag([sigma**2, k1_sigma**2, 0.0, 0.0, 0.0, 0.0, 0.0])


def test_what_the_lens_may_move_is_noise_beside_a_pixel():
    """The variance of an observation under many lenses of the given standard deviations."""
    generator = np.random.default_rng(0)
    k1, k3 = generator.normal(0.0, (0.003, 0.02), (100_000, 2)).T
    weights = weigh(AXIS_HALF_BORDER, CAMERA, (0.003, 0.02))
    for at, weight in zip(AXIS_HALF_BORDER, weights, strict=True):
        x = (at[0] - CAMERA.cx) / CAMERA.fx
        moved = CAMERA.fx * (k1 * x**3 + k3 * x**7) + generator.normal(size=len(k1))
        assert weight == pytest.approx(1.0 / moved.var(), rel=0.02)


@pytest.mark.parametrize(
    ("uncertain", "covariance", "sigmas"),
    [
        (CalibrationUncertainty(), None, (0.0, 0.0)),  # k1 is adjusted, too
        (CalibrationUncertainty(k1=0.0), None, (0.0, 0.0)),  # it is right
        (UNKNOWN, None, (0.1, 0.1)),
        (UNKNOWN, found(0.1, 0.03), (0.03, 0.1)),
        (UNKNOWN, found(0.02, 0.03), (0.0, 0.1)),  # no guess any more
    ],
)
def test_an_adjustment_of_k1_lets_more_of_the_image_count(uncertain, covariance, sigmas):
    points = Landmarks()
    rows = points.allocate(3)
    points.promote(rows)
    keyframe = Keyframe(
        id=0, frame=0, segment=0, T_world_camera=np.eye(4), rows=rows,
        points_px=AXIS_HALF_BORDER, rolled_px=np.zeros((3, 2), np.float32),
    )  # fmt: skip
    known = SelfCalibration.of(CAMERA, uncertain)
    if covariance is not None:
        known = known.corrected(np.zeros(7), covariance, 9)
    seen = list_observations([keyframe], points, known)
    expected = weigh(AXIS_HALF_BORDER, CAMERA, sigmas)
    np.testing.assert_array_equal(seen.weights[np.argsort(-seen.px[:, 0])], expected)
    assert (expected[-1] < 1.0) == any(sigmas)


def test_observations_weigh_by_the_uncertainty_of_the_camera():
    points = Landmarks()
    rows = points.allocate(3)
    given = SelfCalibration.of(CAMERA, CalibrationUncertainty())
    active = ActiveMap(Segment(id=0, points=points), 0, given, MappingParameters())
    active.segment.keyframes.append(
        Keyframe(
            id=0, frame=0, segment=0, T_world_camera=np.eye(4), rows=rows,
            points_px=AXIS_HALF_BORDER, rolled_px=np.zeros((3, 2), np.float32),
        )
    )  # fmt: skip
    active.rebuild_window()
    np.testing.assert_array_equal(active.window.w[0], weigh(AXIS_HALF_BORDER, CAMERA, (0.02, 0.0)))
    active.use_calibration(given.with_lens(np.zeros(7), found(0.001, 0.002)))
    np.testing.assert_array_equal(active.window.w[0], weigh(AXIS_HALF_BORDER, CAMERA, (0.002, 0.0)))
