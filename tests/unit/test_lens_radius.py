"""How much less observations count far from the axis, with the lens held and with it free."""

import numpy as np
import pytest

from pliant.algorithms.bundle.problem import CalibrationUncertainty
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.mapping.final_adjustment import list_map
from pliant.algorithms.mapping.map_store import Keyframe, PointRows
from pliant.algorithms.mapping.parameters import MappingParameters, WindowParameters
from pliant.algorithms.mapping.self_calibration import SelfCalibration

CAMERA = PinholeCamera(width=640, height=480, fx=320.0, fy=320.0, cx=320.0, cy=240.0)
"""Its left border lies at -1 on the plane z = 1."""


@pytest.mark.parametrize(
    ("uncertain", "found", "radius"),
    [
        (CalibrationUncertainty(), None, 0.5),  # focal length and k1 are adjusted, too
        (CalibrationUncertainty(focal=0.0), None, 0.25),
        (CalibrationUncertainty(k1=0.0), None, 0.25),
        (CalibrationUncertainty(focal=0.3), None, 0.25),  # a guess
        (CalibrationUncertainty(focal=0.3), 0.1, 0.25),
        (CalibrationUncertainty(focal=0.3), 0.02, 0.5),  # one that has been replaced
    ],
)
def test_a_free_lens_lets_more_of_the_image_count(
    uncertain: CalibrationUncertainty, found: float | None, radius: float
):
    parameters = MappingParameters(window=WindowParameters(lens_radius=0.25), calibration=uncertain)
    points = PointRows()
    rows = points.allocate(3)
    points.promote(rows)
    on_axis, half, border = 320.0, 320.0 - 320.0 * radius, 0.0
    keyframe = Keyframe(
        id=0,
        frame=0,
        segment=0,
        T_world_camera=np.eye(4),
        rows=rows,
        points_px=np.array([(on_axis, 240), (half, 240), (border, 240)], np.float32),
        rolled_px=np.zeros((3, 2), np.float32),
    )
    known = SelfCalibration.of(CAMERA, uncertain)
    if found is not None:
        known = known.corrected(np.zeros(6), np.diag([found**2, 0.0, 0.0, 0.0, 0.0, 0.0]), 9)
    seen = list_map([keyframe], points, known, parameters)
    expected = [1.0, 0.5, 1.0 / (1.0 + radius**-4)]
    np.testing.assert_allclose(seen.weights[np.argsort(-seen.px[:, 0])], expected, rtol=1e-5)
