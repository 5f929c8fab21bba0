"""Triangulation over a dense table of observations."""

import numpy as np
from mapping_scene import CAMERA, Scene, looking, sideways

from pliant.algorithms.geometry import inverse, transform
from pliant.algorithms.slam.estimate.triangulation import spread_of_rays, triangulate


def table(noise_px=0.0, count=300):
    scene = Scene.box(count)
    poses = np.array(sideways(8))
    generator = np.random.default_rng(1)
    px = np.array([CAMERA.project(transform(inverse(T), scene.points)) for T in poses])
    px += generator.normal(0.0, noise_px, px.shape)
    seen = generator.random(px.shape[:2]) < 0.7
    seen[[0, -1]] = True
    return scene.points, poses, px[..., 0].astype(np.float32), px[..., 1].astype(np.float32), seen


def test_exact_rays_meet_in_the_point():
    points, poses, u, v, seen = table()
    columns = np.arange(len(points))
    xyz, errors, _, _ = triangulate(poses, u, v, seen, columns, CAMERA)
    assert errors.max() < 1e-3
    np.testing.assert_allclose(xyz, points, rtol=1e-3)


def test_only_requested_columns_are_solved_and_blind_cameras_ignored():
    points, poses, u, v, seen = table()
    u[~seen], v[~seen] = np.nan, np.nan
    columns = np.array([5, 17, 200])
    xyz, errors, parallax, sigmas = triangulate(poses, u, v, seen, columns, CAMERA)
    np.testing.assert_allclose(xyz, points[columns], rtol=1e-3)
    assert xyz.shape == (3, 3)
    assert errors.shape == parallax.shape == sigmas.shape == (3,)


def test_sigma_is_what_noise_of_one_pixel_does_to_depth():
    points, poses, u, v, seen = table(noise_px=1.0, count=4000)
    seen[:] = True
    columns = np.arange(len(points))
    xyz, _, _, sigmas = triangulate(poses, u, v, seen, columns, CAMERA)
    wide = sigmas < 0.05
    depth_error = (xyz[:, 2] - points[:, 2]) / points[:, 2]
    ratio = depth_error[wide] / sigmas[wide]
    # Only motion across the first ray is counted, hence good to a factor of two.
    assert 0.5 < np.std(ratio) < 2.0


def test_parallax_is_the_widest_angle_between_rays():
    points, poses, _, _, seen = table()
    columns = np.arange(len(points))
    parallax, _ = spread_of_rays(poses, seen, columns, points, focal_px=CAMERA.fx)
    rays = points[None] - poses[:, None, :3, 3]
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    for n in range(0, len(points), 29):
        own = rays[seen[:, n], n]
        widest = np.arccos(np.clip(own @ own.T, -1.0, 1.0)).max()
        assert 0.9 * widest <= parallax[n] <= widest + 1e-5


def test_rays_that_do_not_meet_ahead_have_infinite_error():
    poses = np.array([looking((0.0, 0.0, 0.0)), looking((1.0, 0.0, 0.0))])
    u = np.array([[200.0, 319.5], [400.0, 319.5]], np.float32)
    v = np.full((2, 2), 239.5, np.float32)
    seen = np.ones((2, 2), np.bool_)
    _, errors, _, _ = triangulate(poses, u, v, seen, np.arange(2), CAMERA)
    assert np.isinf(errors[0])


def test_one_ray_has_no_spread():
    poses = np.array([looking((0.0, 0.0, 0.0)), looking((1.0, 0.0, 0.0))])
    seen = np.array([[True], [False]])
    xyz = np.array([[0.0, 0.0, 5.0]])
    parallax, sigmas = spread_of_rays(poses, seen, np.arange(1), xyz, focal_px=500.0)
    assert parallax[0] == 0.0
    assert np.isinf(sigmas[0])
