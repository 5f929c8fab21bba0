"""Images that are exported: where they show what, and nothing that no lens has shown."""

import numpy as np
import pytest

from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.slam.calibration.corrected_view import corrected_view
from pliant.algorithms.slam.calibration.rolling_shutter import RolledFrame
from pliant.export.images import ShownView

CAMERA = PinholeCamera(width=160, height=120, fx=100.0, fy=100.0, cx=79.5, cy=59.5)
MOTION = np.array([0.02, -0.03, 0.01, 0.05, 0.02, -0.02])


@pytest.mark.parametrize("correction", [(), (0.05, 0.04, -0.01, 0.0), (0.0, -0.05, 0.0, 0.0)])
@pytest.mark.parametrize("readout", [0.0, 0.8])
def test_pixels_are_where_the_image_shows_them(
    correction: tuple[float, ...], readout: float
) -> None:
    whole = corrected_view(CAMERA, correction)
    view = ShownView(whole)
    rolled = RolledFrame(whole, readout, MOTION, 0.4) if readout else None
    u, v = np.meshgrid(np.arange(160), np.arange(120))
    shown = view.image(np.stack([u, v, 0 * u], axis=2).astype(np.uint8), rolled)
    assert shown.shape[:2] == (view.camera.height, view.camera.width)
    there = np.mgrid[20:90:7, 20:130:7][::-1].reshape(2, -1).T
    seen = shown[there[:, 1], there[:, 0], :2].astype(np.float32)
    np.testing.assert_allclose(view.pixels(seen, rolled), there, atol=0.9)  # of whole numbers


def test_what_no_lens_has_shown_is_cut_off() -> None:
    assert ShownView(corrected_view(CAMERA, ())).camera == CAMERA
    stretched = corrected_view(CAMERA, (0.0, 0.05, 0.0, 0.0))
    camera = ShownView(stretched).camera
    assert 140 < camera.width < 160
    assert 105 < camera.height < 120
    corners = np.array([[0, 0], [camera.width - 1, camera.height - 1]], np.float32)
    seen = stretched.seen(corners + np.float32([79.5 - camera.cx, 59.5 - camera.cy]))
    assert (seen >= -0.5).all()
    assert (seen <= (159.5, 119.5)).all()
