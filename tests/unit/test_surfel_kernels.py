"""Surfels: sums, Jacobians, ambiguities, damped steps, corners and tangents."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from surfel_scene import EVERYWHERE, level_of, slanted_surfels, waves

from pliant.algorithms.arrays import F32, F64
from pliant.algorithms.geometry import so3_exp
from pliant.algorithms.surfels import deformation_models as motion
from pliant.algorithms.surfels.births import find_corners, make_templates, smaller_eigenvalues
from pliant.algorithms.surfels.depth_maps import fit_inverse_depth, tangent_jacobian
from pliant.algorithms.surfels.patch_sampling import (
    BIAS,
    GAIN,
    INVALID,
    A,
    B,
    F,
    X,
    homography,
    make_grid,
    sample_patch,
)
from pliant.algorithms.surfels.photometric import (
    FEATURES,
    Comparison,
    correlation,
    feature_matrix,
    make_features,
    padded,
    photometric_sums,
)
from pliant.algorithms.surfels.surfel_alignment import (
    Templates,
    factorise,
    inverse_diagonal,
    invert,
    solve,
)

SIDE = 23
HIGH = 1e6


def sampled(pose: F64, image: F32, side: int = SIDE) -> F32:
    level, grid, h = level_of(image), make_grid(side), np.zeros(9)
    assert homography(pose, level, h)
    assert sample_patch(h, level, grid, HIGH)
    return grid.values.copy()


def test_samples_are_those_of_the_projected_grid() -> None:
    image, pose = waves(), slanted_surfels(seed=4)[0]
    pose[F : F + 3] = 1.1, 0.05, 0.9
    level, half = level_of(image), SIDE // 2
    j, i = np.mgrid[-half : half + 1, -half : half + 1]
    u, v = i.ravel() * level.step_u, j.ravel() * level.step_v
    du, dv = 1.1 * u + 0.05 * v, 0.05 * u + 0.9 * v
    points = pose[X : X + 3] + du[:, None] * pose[A : A + 3] + dv[:, None] * pose[B : B + 3]
    x = level.fx * points[:, 0] / points[:, 2] + level.cx
    y = level.fy * points[:, 1] / points[:, 2] + level.cy
    column, row = np.floor(x).astype(int), np.floor(y).astype(int)
    p, q = x - column, y - row
    top = (1 - p) * image[row, column] + p * image[row, column + 1]
    bottom = (1 - p) * image[row + 1, column] + p * image[row + 1, column + 1]
    np.testing.assert_allclose(sampled(pose, image), (1 - q) * top + q * bottom, atol=2e-3)


def test_samples_outside_and_highlights_are_invalid() -> None:
    image = waves()
    image[55:60, 75:80] = 255.0
    pose = slanted_surfels(seed=1)[0]
    pose[X : X + 3] = 0.0, 0.0, 1.0
    level, grid, h = level_of(image), make_grid(SIDE), np.zeros(9)
    assert homography(pose, level, h)
    assert sample_patch(h, level, grid, 250.0)
    assert (grid.values == np.float32(INVALID)).any()
    pose[X] = 0.5
    assert homography(pose, level, h)
    assert sample_patch(h, level, grid, HIGH)
    assert (grid.values == np.float32(INVALID)).all()


@pytest.mark.parametrize("bad", [-1.0, 0.0, np.nan, np.inf, 1e30])
def test_a_patch_that_is_nowhere_is_refused(bad: float) -> None:
    pose = slanted_surfels()[0]
    pose[X + 2] = bad
    level, h = level_of(waves()), np.zeros(9)
    assert not (homography(pose, level, h) and sample_patch(h, level, make_grid(SIDE), HIGH))


ROW = SIDE + 2
INNER = (slice(None), np.arange(padded(SIDE)) % ROW < SIDE)
"""The samples of a texture: two between rows it lacks."""


def sums_of(
    pose: F64, image: F32, texture: F32, mean: float, tau: float = 1e5, blend: float = 1.0
) -> tuple[float, int, F32, F64, F64]:
    """Cost, samples seen, features (10, n), matrix and sums of a pose."""
    grid, h, level = make_grid(ROW), np.zeros(9), level_of(image)
    features = make_features(SIDE)
    matrix, sums = np.zeros((FEATURES, FEATURES)), np.zeros(FEATURES)
    assert homography(pose, level, h)
    assert sample_patch(h, level, grid, HIGH)
    comparison = Comparison(mean, pose[GAIN], pose[BIAS], tau, blend)
    cost, seen = photometric_sums(texture, grid, comparison, sums)
    feature_matrix(texture, grid, comparison, features, matrix)
    return cost, seen, features[:FEATURES], matrix, sums


def blank() -> F32:
    """A texture of zeros."""
    texture = np.zeros((3, padded(SIDE)), np.float32)
    texture[0, ~INNER[1]] = INVALID
    return texture


def ramps() -> F32:
    """An image that bilinear interpolation and central differences reproduce exactly."""
    v, u = np.mgrid[0:120, 0:160].astype(np.float64)
    return (20.0 + 0.9 * u - 0.5 * v + 0.012 * u * v).astype(np.float32)


@pytest.mark.parametrize("model", motion.MODELS.values(), ids=motion.MODELS)
@pytest.mark.parametrize("seed", range(3))
def test_jacobians_by_finite_differences(model: int, seed: int) -> None:
    image, pose = ramps(), slanted_surfels(seed=seed)[0]
    pose[F : F + 3] = (1.1, 0.07, (1 + 0.0049) / 1.1) if model else (1, 0, 1)
    if model == motion.GENERAL:
        pose[F + 2] = 0.8
    pose[GAIN], pose[BIAS] = 1.3, 4.0
    mean = 110.0
    _, seen, features, matrix, sums = sums_of(pose, image, blank(), mean)
    assert seen == SIDE * SIDE
    features = features[INNER]
    n = motion.parameter_count(model)
    mix = np.zeros((FEATURES, motion.MOST_PARAMETERS))
    motion.mixing(pose, level_of(image), model, mix)
    J = features[:FEATURES].T.astype(np.float64) @ mix[:, :n]
    after = np.zeros_like(pose)
    for k in range(n):
        residuals = []
        delta = 2e-3 if k < 3 else 1e-2
        for sign in (1.0, -1.0):
            step = np.zeros(motion.MOST_PARAMETERS)
            step[k] = sign * delta
            motion.apply_step(pose, step, model, after)
            residuals.append(after[GAIN] * (sampled(after, image) - mean) + after[BIAS])
        expected = (residuals[0] - residuals[1]) / (2.0 * delta)
        scale = np.abs(expected).max()
        np.testing.assert_allclose(J[:, k], expected, atol=0.01 * scale, err_msg=f"parameter {k}")
    # The small matrices are those of the whole Jacobian.
    H, g = np.zeros((motion.MOST_PARAMETERS,) * 2), np.zeros(motion.MOST_PARAMETERS)
    scratch = np.zeros((FEATURES, motion.MOST_PARAMETERS))
    motion.hessian(matrix, 1.0, mix, n, scratch, H)
    motion.gradient(sums, mix, n, g)
    np.testing.assert_allclose(H[:n, :n], J.T @ J, rtol=1e-3, atol=1e-4 * np.abs(H).max())
    r = pose[GAIN] * (sampled(pose, image).astype(np.float64) - mean) + pose[BIAS]
    np.testing.assert_allclose(g[:n], J.T @ r, rtol=1e-3, atol=1e-4 * np.abs(g).max())


def test_a_sparse_level_has_every_second_sample_of_a_dense_one() -> None:
    pose, image, h = slanted_surfels(seed=5)[0], waves(), np.zeros(9)
    samples: list[F32] = []
    for side, stride in ((25, 1), (13, 2)):
        level, grid = level_of(image, side=side, stride=stride), make_grid(side)
        assert homography(pose, level, h)
        assert sample_patch(h, level, grid, HIGH)
        samples.append(grid.values.reshape(side, side))
    np.testing.assert_allclose(samples[1], samples[0][::2, ::2], atol=1e-2)


def texture_and_moved() -> tuple[F32, Templates, F64]:
    """An image, the texture of a surfel in it, and that surfel a little beside, lit otherwise."""
    image, poses = waves(), slanted_surfels(seed=5)
    templates = make_templates(poses, level_of(image, side=SIDE), HIGH, 0.5, EVERYWHERE, np.inf)
    moved = poses[0].copy()
    moved[X] += 0.02
    moved[GAIN], moved[BIAS] = 1.1, 2.0
    return image, templates, moved


def test_texture_and_frame_agree_where_the_surfel_is() -> None:
    image, templates, _ = texture_and_moved()
    pose = slanted_surfels(seed=5)[0]
    pose[GAIN], pose[BIAS] = 2.0, 7.0
    mean, tau = templates.means[0], 10.0
    paler = ((image - mean - 7.0) / 2.0 + mean).astype(np.float32)
    for blend in (0.0, 0.5, 1.0):
        cost, seen, _, matrix, sums = sums_of(pose, paler, templates.images[0], mean, tau, blend)
        assert seen == SIDE * SIDE
        assert cost == pytest.approx((padded(SIDE) - seen) * tau**2, rel=1e-4)
        scale = np.sqrt(np.outer(np.diag(matrix), np.diag(matrix)))
        np.testing.assert_allclose(matrix / scale, templates.matrices[0] / scale, atol=2e-3)
        np.testing.assert_allclose(sums / np.sqrt(np.diag(matrix)), 0.0, atol=0.5)


@pytest.mark.parametrize("blend", [0.0, 0.5, 1.0])
def test_sums_against_numpy(blend: float) -> None:
    image, templates, moved = texture_and_moved()
    mean, tau = templates.means[0], 8.0
    cost, seen, features, matrix, out = sums_of(moved, image, templates.images[0], mean, tau, blend)
    wide = sampled(moved, image, ROW).astype(np.float64).reshape(ROW, ROW)
    t, tu, tv = templates.images[0][INNER].astype(np.float64)
    level = (1.1 * (wide[1:-1, 1:-1] - mean) + 2.0).ravel()
    r = level - t
    inside = np.abs(r) < tau
    assert 0 < inside.sum() < len(r)
    assert seen == inside.sum()
    lacking = padded(SIDE) - len(r)
    assert cost == pytest.approx(np.minimum(r**2, tau**2).sum() + lacking * tau**2, rel=1e-4)
    u = (1.0 - blend) * tu + blend * 0.55 * (wide[1:-1, 2:] - wide[1:-1, :-2]).ravel()
    v = (1.0 - blend) * tv + blend * 0.55 * (wide[2:, 1:-1] - wide[:-2, 1:-1]).ravel()
    half = SIDE // 2
    j, i = (each.ravel() for each in np.mgrid[-half : half + 1, -half : half + 1])
    d, grey = i * u + j * v, (1.0 - blend) * t + blend * level
    rows = np.array([u, v, i * u, j * u, i * v, j * v, i * d, j * d, grey, np.ones_like(t)])
    rows = np.where(inside, rows, 0.0)
    np.testing.assert_allclose(features[INNER], rows, atol=1e-3 * np.abs(rows).max())
    assert not features[:, ~INNER[1]].any()
    expected = rows @ r
    np.testing.assert_allclose(out, expected, rtol=1e-3, atol=1e-4 * np.abs(expected).max())
    expected = rows @ rows.T
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(matrix / scale, expected / scale, atol=1e-5)


def normal_matrix(model: int) -> tuple[F64, F64]:
    image, poses = waves(), slanted_surfels(seed=6)
    level, n = level_of(image), motion.parameter_count(model)
    templates = make_templates(poses, level, HIGH, 0.5, EVERYWHERE, np.inf)
    mix = np.zeros((FEATURES, motion.MOST_PARAMETERS))
    motion.mixing(poses[0], level, model, mix)
    H = np.zeros((motion.MOST_PARAMETERS,) * 2)
    scratch = np.zeros((FEATURES, motion.MOST_PARAMETERS))
    motion.hessian(templates.matrices[0], 1.0, mix, n, scratch, H)
    return H[: n - 2, : n - 2], poses[0]


def test_growing_map_ambiguity() -> None:
    """Eq. 7-9: farther and larger is the same image."""
    image, pose = waves(), slanted_surfels(seed=6)[0]
    grown = pose.copy()
    grown[X : X + 3] *= 1.3
    grown[F : F + 3] *= 1.3
    np.testing.assert_allclose(sampled(grown, image), sampled(pose, image), atol=1e-2)
    H, pose = normal_matrix(motion.GENERAL)
    direction = np.zeros(len(H))
    direction[:3], direction[6], direction[8] = pose[X : X + 3], 1.0, 1.0
    along_ray = np.zeros(len(H))
    along_ray[:3] = pose[X : X + 3]
    assert direction @ H @ direction < 1e-6 * (along_ray @ H @ along_ray)


def test_isometry_resolves_the_depth() -> None:
    H, _ = normal_matrix(motion.ISOMETRIC)
    scaled = H / np.sqrt(np.outer(np.diag(H), np.diag(H)))
    assert np.linalg.eigvalsh(scaled)[0] > 1e-5


@given(st.floats(0.5, 2.0), st.floats(-0.5, 0.5))
@settings(max_examples=30)
def test_equiareal_steps_keep_the_area(alpha: float, beta: float) -> None:
    """Table I prints (1 + beta) / alpha, whose determinant is not one."""
    pose, out = slanted_surfels()[0], np.zeros(14)
    step = np.zeros(motion.MOST_PARAMETERS)
    step[6], step[7] = alpha - 1.0, beta
    motion.apply_step(pose, step, motion.EQUIAREAL, out)
    assert out[F] * out[F + 2] - out[F + 1] ** 2 == pytest.approx(1.0)
    if abs(beta - beta**2) > 1e-3:
        assert out[F] * (1.0 + beta) / out[F] - beta**2 != pytest.approx(1.0, abs=1e-4)


def test_steps_against_numpy() -> None:
    rng = np.random.default_rng(0)
    J = rng.standard_normal((30, 8)) * 10.0 ** rng.uniform(-3, 3, 8)
    H, g, n = J.T @ J, J.T @ rng.standard_normal(30), 8
    L, scale, step = np.zeros((n, n)), np.zeros(n), np.zeros(n)
    assert factorise(H, n, 6, 0.5, L, scale)
    solve(L, scale, n, g, step)
    damped = H + np.diag(np.r_[0.5 * np.diag(H)[:6], 0.0, 0.0])
    np.testing.assert_allclose(step, -np.linalg.solve(damped, g), rtol=1e-5)
    inverse = np.zeros((n, n))
    invert(L, scale, n, np.zeros(n), inverse)
    scale_of_rows = np.sqrt(np.diag(damped))
    unit = inverse * np.outer(scale_of_rows, scale_of_rows)
    expected = np.linalg.inv(damped / np.outer(scale_of_rows, scale_of_rows))
    np.testing.assert_allclose(unit, expected, rtol=1e-5, atol=1e-6)
    trace = inverse_diagonal(L, scale, n, 3, np.zeros(n))
    assert trace == pytest.approx(np.trace(np.linalg.inv(damped)[:3, :3]), rel=1e-5)
    assert not factorise(np.full((n, n), np.nan), n, 6, 0.5, L, scale)


def test_parameters_that_nothing_depends_on_stay() -> None:
    H, g, n = np.diag([4.0, 0.0, 9.0]), np.array([4.0, 0.0, 9.0]), 3
    L, scale, step = np.zeros((n, n)), np.zeros(n), np.zeros(n)
    assert factorise(H, n, 3, 0.0, L, scale)
    solve(L, scale, n, g, step)
    np.testing.assert_allclose(step, [-1.0, 0.0, -1.0], rtol=1e-6)


def test_correlation_ignores_light_and_what_is_missing() -> None:
    rng = np.random.default_rng(1)
    t = rng.uniform(-50, 50, 529).astype(np.float32)
    v = (0.6 * t + 80.0).astype(np.float32)
    v[:100] = INVALID
    assert correlation(t, v) == (pytest.approx(1.0, abs=1e-5), 429)
    other = rng.uniform(0, 255, 529).astype(np.float32)
    expected = np.corrcoef(t, other)[0, 1]
    assert correlation(t, other)[0] == pytest.approx(expected, abs=1e-5)
    assert correlation(t, np.full(529, 20.0, np.float32))[0] == 0.0
    assert correlation(t, np.full(529, INVALID, np.float32)) == (0.0, 0)


def test_corners_against_numpy() -> None:
    rng = np.random.default_rng(2)
    image = rng.uniform(0, 255, (40, 50)).astype(np.float32)
    strength = smaller_eigenvalues(image, 3)
    gy, gx = np.gradient(image.astype(np.float64))
    for row, column in ((4, 4), (20, 25), (35, 45)):
        x = gx[row - 3 : row + 4, column - 3 : column + 4].ravel()
        y = gy[row - 3 : row + 4, column - 3 : column + 4].ravel()
        tensor = np.array([[x @ x, x @ y], [x @ y, y @ y]]) / 49.0
        assert strength[row, column] == pytest.approx(np.linalg.eigvalsh(tensor)[0], rel=1e-3)
    allowed = np.ones((40, 50), np.uint8)
    allowed[:, 25:] = 0
    corners = find_corners(image, allowed, window=7, threshold=1.0, radius=5, margin=6)
    assert len(corners) > 2
    assert (corners[:, 0] < 25).all()
    assert (np.diff(corners[:, 2]) <= 0).all()
    apart = np.abs(corners[:, None, :2] - corners[None, :, :2]).max(axis=2)
    assert (apart + 99 * np.eye(len(corners)) > 5).all()


def plane_depth(shape: tuple[int, int], a: float, b: float, c: float) -> F64:
    """1 / (a + b u + c v)."""
    v, u = np.mgrid[0 : shape[0], 0 : shape[1]]
    return 1.0 / (a + b * u + c * v)


def test_tangent_of_a_plane_is_exact() -> None:
    """Eq. 4 against finite differences of the surface itself."""
    f, cx, cy = 200.0, 30.0, 20.0
    depth, out = plane_depth((60, 80), 1.0, 0.002, -0.001), np.zeros(4)
    share = fit_inverse_depth(depth, 40.0, 30.0, 11, 0.3, 1e-4, out)
    assert share == pytest.approx(1.0)
    z = 1.0 / out[0]
    dz_dx, dz_dy = -z * z * out[1] * f, -z * z * out[2] * f
    x, y = (40.0 - cx) / f, (30.0 - cy) / f
    J = tangent_jacobian(*(np.array([each]) for each in (x, y, z, dz_dx, dz_dy)))[0]

    def surface(x: float, y: float) -> F64:
        z = 1.0 / (1.0 + 0.002 * (f * x + cx) - 0.001 * (f * y + cy))
        return z * np.array([x, y, 1.0])

    d = 1e-6
    np.testing.assert_allclose(
        J[:, 0], (surface(x + d, y) - surface(x - d, y)) / (2 * d), rtol=1e-5
    )
    np.testing.assert_allclose(
        J[:, 1], (surface(x, y + d) - surface(x, y - d)) / (2 * d), rtol=1e-5
    )


def test_tangent_near_an_edge_with_holes_and_noise() -> None:
    rng = np.random.default_rng(3)
    depth = plane_depth((60, 80), 1.0, 0.003, 0.001)
    truth = 1.0 / (1.0 + 0.003 * 40.0 + 0.001 * 30.0)
    depth += 0.001 * rng.standard_normal(depth.shape)
    depth[:, 46:] = 1.6
    depth[rng.random(depth.shape) < 0.2] = 0.0
    depth[rng.random(depth.shape) < 0.02] = np.nan
    out = np.zeros(4)
    share = fit_inverse_depth(depth, 40.0, 30.0, 11, 0.08, 5e-4, out)
    assert 0.4 < share < 0.75
    assert 1.0 / out[0] == pytest.approx(truth, abs=5e-4)
    assert out[1] == pytest.approx(0.003, abs=2e-4)
    assert out[2] == pytest.approx(0.001, abs=2e-4)


def test_no_tangent_without_depth() -> None:
    out = np.zeros(4)
    assert fit_inverse_depth(np.zeros((40, 40)), 20.0, 20.0, 11, 0.1, 1e-4, out) == 0.0
    line = np.zeros((40, 40))
    line[20, :] = 1.0
    assert fit_inverse_depth(line, 20.0, 20.0, 11, 0.1, 1e-4, out) == 0.0


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 0.5, 2.0, np.pi])
def test_a_step_turns_by_its_rotation_vector(angle: float) -> None:
    axis = np.array([0.48, -0.6, 0.64])
    pose = motion.identity_poses(1)[0]
    pose[motion.A : motion.A + 3], pose[motion.B : motion.B + 3] = (1, 0, 0), (0, 1, 0)
    step, out = np.zeros(motion.parameter_count(motion.EQUIAREAL)), np.zeros_like(pose)
    step[3:6] = angle * axis
    motion.apply_step(pose, step, motion.EQUIAREAL, out)
    R = so3_exp(angle * axis)
    np.testing.assert_allclose(out[motion.A : motion.A + 3], R[:, 0], atol=1e-14)
    np.testing.assert_allclose(out[motion.B : motion.B + 3], R[:, 1], atol=1e-14)
