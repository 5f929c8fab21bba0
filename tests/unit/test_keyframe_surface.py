"""From the points of a keyframe to its depth map: planes and steps, warm start, bad input."""

import numpy as np
import pytest

from pliant.algorithms.arrays import F64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import so3_exp
from pliant.algorithms.meshing.keyframe_surface import KeyframeSurfaces, SeenPoints
from pliant.algorithms.meshing.parameters import NltgvParameters, SurfaceParameters
from pliant.algorithms.slam.calibration.corrected_view import CorrectedView

CAMERA = PinholeCamera(width=160, height=120, fx=140.0, fy=140.0, cx=79.5, cy=59.5)
NOISE = 0.01


def pose(x: float = 0.0, angle: float = 0.0) -> F64:
    T = np.eye(4)
    T[:3, :3] = so3_exp(np.array([[0.0, angle, 0.0]]))[0]
    T[0, 3] = x
    return T


def depth_of(pixels: F64) -> F64:
    """A wall at 4, and at its left a box at 2, as the camera at the origin sees them."""
    return np.where(pixels[:, 0] < 70.0, 2.0, 4.0)


def seen(T: F64, *, count: int = 1500, outliers: float = 0.0, seed: int = 0) -> SeenPoints:
    generator = np.random.default_rng(seed)
    pixels = generator.uniform((0, 0), (160, 120), (count, 2))
    depths = depth_of(pixels) * (1.0 + NOISE * generator.standard_normal(count))
    bad = generator.random(count) < outliers
    depths[bad] = generator.uniform(1.0, 8.0, int(bad.sum()))
    rays = np.concatenate([CAMERA.normalise(pixels), np.ones((count, 1))], axis=1)
    world = rays * depths[:, None]
    local = (world - T[:3, 3]) @ T[:3, :3]
    return SeenPoints(
        ids=np.arange(count, dtype=np.int64),
        points_px=CAMERA.project(local).astype(np.float32),
        points_world=world,
        sigmas=np.full(count, NOISE / SurfaceParameters().noise_px, np.float32),
        keyframes=np.full(count, 5, np.int32),
    )


def errors(depths: "np.ndarray[tuple[int, int], np.dtype[np.float32]]") -> F64:
    v, u = np.nonzero(depths)
    true = depth_of(np.stack([u, v], axis=1).astype(np.float64))
    return np.abs(depths[v, u] / true - 1.0)


def test_a_box_before_a_wall_is_covered_smooth_and_keeps_its_edge() -> None:
    surface = KeyframeSurfaces(CAMERA, SurfaceParameters()).surface(pose(), seen(pose()))
    assert surface.depth_map is not None
    assert surface.problem == ""
    assert np.mean(surface.depth_map.depths > 0.0) > 0.9
    error = errors(surface.depth_map.depths)
    assert np.median(error) < 0.3 * NOISE
    assert np.mean(error > 0.05) < 0.01  # nothing stretches from the box to the wall


def test_outliers_vanish_as_they_do_not_without_smoothing() -> None:
    points = seen(pose(), outliers=0.1)
    kinds = {
        "smooth": SurfaceParameters(),
        "rough": SurfaceParameters(
            nltgv=NltgvParameters(data_weight=1e6, data_sigmas=0.0, reweightings=1)
        ),
    }
    rms, covered = {}, {}
    for kind, parameters in kinds.items():
        surface = KeyframeSurfaces(CAMERA, parameters).surface(pose(), points)
        assert surface.depth_map is not None
        covered[kind] = float(np.mean(surface.depth_map.depths > 0.0))
        rms[kind] = float(np.sqrt(np.mean(errors(surface.depth_map.depths) ** 2)))
    # Without smoothing, needles are no surface: most are dropped, and leave holes.
    assert rms["smooth"] < 0.7 * rms["rough"]
    assert covered["smooth"] > covered["rough"] + 0.2


def test_the_next_keyframe_starts_from_the_last_and_comes_to_the_same() -> None:
    there = pose(0.2, 0.05)
    surfaces = KeyframeSurfaces(CAMERA, SurfaceParameters())
    surfaces.surface(pose(), seen(pose()))
    warm = surfaces.surface(there, seen(there))
    cold = KeyframeSurfaces(CAMERA, SurfaceParameters()).surface(there, seen(there))
    assert warm.depth_map is not None
    assert cold.depth_map is not None
    assert warm.iterations < 0.7 * cold.iterations
    both = (warm.depth_map.depths > 0.0) & (cold.depth_map.depths > 0.0)
    difference = np.abs(warm.depth_map.depths[both] / cold.depth_map.depths[both] - 1.0)
    assert np.median(difference) < 0.2 * NOISE


def test_a_jump_of_the_pose_does_no_harm() -> None:
    surfaces = KeyframeSurfaces(CAMERA, SurfaceParameters())
    surfaces.surface(pose(), seen(pose()))
    jumped = surfaces.surface(pose(50.0), seen(pose()))
    assert jumped.depth_map is None
    assert "points with depth" in jumped.problem
    again = surfaces.surface(pose(), seen(pose()))
    assert again.depth_map is not None


@pytest.mark.parametrize(
    ("wrong", "problem"),
    [
        ("none", "0 points"),
        ("two", "2 points"),
        ("line", "one line"),
        ("one place", "one line"),
        ("nan", "0 points"),
        ("behind", "0 points"),
        ("uncertain", "none of its triangles"),
        ("pose", "not finite"),
    ],
)
def test_what_is_no_surface_is_said_and_passed_over(wrong: str, problem: str) -> None:
    T, points = pose(), seen(pose(), count=50)
    values = dict(vars(points))
    world, pixels = values["points_world"], values["points_px"]
    if wrong in ("none", "two"):
        values = {name: value[: 2 * (wrong == "two")] for name, value in values.items()}
    elif wrong in ("line", "one place"):
        spread = np.linspace(-0.5, 0.5, 50) if wrong == "line" else np.zeros(50)
        world[:] = np.stack([spread, 0.0 * spread, np.full(50, 2.0)], axis=1)
        pixels[:] = CAMERA.project(world)
    elif wrong == "nan":
        world[:] = np.nan
    elif wrong == "behind":
        world *= -1.0
    elif wrong == "uncertain":
        values["sigmas"][:] = 3.0
    else:
        T[0, 0] = np.nan
    surface = KeyframeSurfaces(CAMERA, SurfaceParameters()).surface(T, SeenPoints(**values))
    assert surface.depth_map is None
    assert problem in surface.problem


def test_the_order_of_points_does_not_matter() -> None:
    points = seen(pose())
    order = np.random.default_rng(1).permutation(len(points.ids))
    shuffled = SeenPoints(**{name: value[order] for name, value in vars(points).items()})
    a = KeyframeSurfaces(CAMERA, SurfaceParameters()).surface(pose(), points)
    b = KeyframeSurfaces(CAMERA, SurfaceParameters()).surface(pose(), shuffled)
    assert a.depth_map is not None
    assert b.depth_map is not None
    assert a.depth_map.depths.tobytes() == b.depth_map.depths.tobytes()


def test_a_wrong_calibration_is_corrected_in_pixels_and_image() -> None:
    correction = (0.05, 0.02, -0.01)
    generator = np.random.default_rng(0)
    ideal = generator.uniform((20, 20), (140, 100), (200, 2))
    rays = CAMERA.normalise(ideal)
    squared = (rays**2).sum(axis=1, keepdims=True)
    seen_px = rays * np.exp(0.05) * (1.0 + 0.02 * squared - 0.01 * squared**2)
    seen_px = seen_px * (CAMERA.fx, CAMERA.fy) + (CAMERA.cx, CAMERA.cy)
    view = CorrectedView(CAMERA, correction)
    np.testing.assert_allclose(view.pixels(seen_px.astype(np.float32)), ideal, atol=1e-3)
    # A ramp in the rectified image tells where each pixel of the ideal one was taken from.
    ramp = np.tile(np.arange(160, dtype=np.uint8), (120, 1))
    image = view.image(np.repeat(ramp[..., None], 3, axis=2))
    rows = np.round(ideal).astype(int)
    same = CorrectedView(CAMERA, correction).pixels
    at = image[rows[:, 1], rows[:, 0], 0].astype(np.float32)
    back = same(np.stack([at, np.interp(rows[:, 1], ideal[:, 1], seen_px[:, 1])], axis=1))
    assert np.median(np.abs(back[:, 0] - rows[:, 0])) < 1.0
    untouched = CorrectedView(CAMERA, ())
    assert untouched.pixels(seen_px.astype(np.float32)).dtype == np.float32
    assert untouched.image(image) is image
