"""Cameras and depths of surfels by the final map, against exact ground truth."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pytest
from breathing_truth import CAMERA, FPS, FRAMES, rigid_map, tracks, write_truth

from pliant.algorithms.arrays import F64, I64
from pliant.algorithms.deformable.followed_map import FollowedMap
from pliant.algorithms.deformable.judged_map import judged_map
from pliant.algorithms.geometry import inverse, pose_to_matrix, so3_exp, transform
from pliant.algorithms.surfels.final_surfels import FinalSurfels, SurfelsByMap, depths_around
from pliant.algorithms.surfels.surfel_frame import SurfelFrame
from pliant.evaluation.surface_truth import MaterialPoints, SurfaceTruth

STEP_NS = 1_000_000_000 // FPS
START, UNIT = 3, 0.6
BLIND = (41, 43)
"""Frames without tracks, between keyframes."""


@dataclass
class Scene:
    """Surfels as they are online, and exact ones in their world and unit, by frame."""

    online: list[SurfelFrame]
    T_exact: F64
    exact: list[F64]
    found: FinalSurfels

    def corrected(self) -> Iterator[tuple[int, SurfelFrame]]:
        for n, each in enumerate(self.online):
            yield n, self.found.corrected(each, each.frame * STEP_NS)


def surfels_online(truth: SurfaceTruth) -> tuple[list[SurfelFrame], F64, list[F64]]:
    """The camera is up to 2 % of the depth off and each surfel by 1 % of its own, but at first."""
    rng = np.random.default_rng(4)
    where = rng.uniform((40.0, 30.0), (110.0, 90.0), (300, 2))
    points = MaterialPoints(np.zeros(300, np.int32), where)
    births = np.exp(0.01 * rng.standard_normal(300))
    world = inverse(truth.T_world_camera[START])
    online, poses, exact = list[SurfelFrame](), list[F64](), list[F64]()
    for frame in range(START, FRAMES):
        T = world @ truth.T_world_camera[frame]
        places = transform(world, truth.positions(points, frame))
        in_camera = transform(inverse(T), places)
        pixels = CAMERA.project(in_camera)
        seen = ((pixels > 0.0) & (pixels < (639.0, 479.0))).all(axis=1)
        wave = np.sin(0.3 * (frame - START))
        T_online = T.copy()
        T_online[:3, :3] = T[:3, :3] @ so3_exp(np.array([[0.0, 0.01 * wave, 0.0]]))[0]
        T_online[:3, 3] += 0.012 * wave
        T, T_online = (np.block([[M[:3, :3], UNIT * M[:3, 3:]], [M[3:]]]) for M in (T, T_online))
        count = int(seen.sum())
        floats = np.ones(count, np.float32)
        in_camera = births[seen, None] * in_camera[seen]
        online.append(
            replace(
                SurfelFrame.empty(),
                frame=frame,
                lost=False,
                T_world_camera=T_online,
                ids=np.flatnonzero(seen),
                positions=transform(T_online, UNIT * in_camera),
                tangents=np.tile(np.eye(3)[:, :2], (count, 1, 1)),
                deformations=np.tile([1.0, 0.0, 1.0], (count, 1)),
                points_px=pixels[seen].astype(np.float32),
                **dict.fromkeys(("zncc", "visible", "sigma", "gains", "biases"), floats),
                state=np.zeros(count, np.uint8),
                age=np.ones(count, np.int32),
                born=np.zeros(count, np.int32),
            )
        )
        poses.append(T)
        exact.append(UNIT * places[seen])
    return online, np.array(poses), exact


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    truth = write_truth(tmp_path_factory.mktemp("truth"))
    seen = tracks(truth)
    keyframes = np.arange(0, FRAMES, 2)
    placed = rigid_map(truth).final()
    T = np.array([pose_to_matrix(placed[n][1][None])[0] for n in keyframes.tolist()])
    judged = judged_map([seen[n][1] for n in keyframes], [seen[n][2] for n in keyframes], T, CAMERA)
    assert not isinstance(judged, str)
    assert not judged.problem
    followed = FollowedMap(judged.found, judged.ids, keyframes * STEP_NS)
    online, T_exact, exact = surfels_online(truth)
    by_map = SurfelsByMap()
    for surfels in online:
        frame, ids, pixels = seen[surfels.frame]
        rows: I64 = np.arange(0 if frame in BLIND else len(ids))
        view = followed.see(frame * STEP_NS, ids[rows], pixels[rows], CAMERA)
        assert (view is None) == (frame in BLIND)
        by_map.take(surfels, frame * STEP_NS, view)
    return Scene(online, T_exact, exact, by_map.found())


def errors(scene: Scene, surfels: list[SurfelFrame]) -> tuple[float, float]:
    """RMSE of camera and of surfels in the world, shares of the depth."""
    depth = float(np.median(transform(inverse(scene.T_exact[0]), scene.exact[0])[:, 2]))
    T = np.array([each.T_world_camera for each in surfels])
    camera = ((T - scene.T_exact)[:, :3, 3] ** 2).sum(axis=1)
    places = np.concatenate(
        [each.positions - there for each, there in zip(surfels, scene.exact, strict=True)]
    )
    return (
        float(np.sqrt(camera.mean())) / depth,
        float(np.sqrt((places**2).sum(axis=1).mean())) / depth,
    )


def test_cameras_and_surfels_are_those_of_the_final_map(scene: Scene) -> None:
    camera, places = errors(scene, scene.online)
    assert camera > 0.015
    assert places > 0.015
    camera, places = errors(scene, [each for _, each in scene.corrected()])
    assert camera < 0.006
    assert places < 0.01


def test_pixels_and_the_first_camera_stay(scene: Scene) -> None:
    first = scene.online[0].T_world_camera
    for n, final in scene.corrected():
        seen = CAMERA.project(transform(inverse(final.T_world_camera), final.positions))
        np.testing.assert_allclose(seen, scene.online[n].points_px, atol=1e-3)
        if n == 0:
            np.testing.assert_allclose(final.T_world_camera, first, atol=1e-12)


def test_tangents_and_sigma_grow_with_the_depth(scene: Scene) -> None:
    online = scene.online[20]
    final = scene.found.corrected(online, online.frame * STEP_NS)
    before, after = (
        transform(inverse(each.T_world_camera), each.positions)[:, 2] for each in (online, final)
    )
    np.testing.assert_allclose(final.sigma, after / before, rtol=1e-5)
    lengths = np.linalg.norm(final.tangents, axis=1)
    np.testing.assert_allclose(lengths, np.stack([after / before] * 2, axis=1), rtol=1e-6)


def test_frames_without_tracks_move_as_the_nearest_that_has_some(scene: Scene) -> None:
    n = BLIND[0] - START
    before, blind = (scene.found.corrected(scene.online[k], 0).T_world_camera for k in (n - 1, n))
    online = inverse(scene.online[n - 1].T_world_camera) @ scene.online[n].T_world_camera
    np.testing.assert_allclose(inverse(before) @ blind, online, atol=1e-9)


def test_what_the_map_does_not_see_stays_as_it_is(scene: Scene) -> None:
    other = replace(scene.online[5], frame=10_000)
    assert scene.found.corrected(other, 0) is other
    by_map = SurfelsByMap()
    by_map.take(scene.online[0], 0, None)
    unchanged = by_map.found().corrected(scene.online[0], 0)
    assert unchanged is scene.online[0]


def test_factors_are_linear_in_time_and_a_new_surfel_has_the_median() -> None:
    surfels = surfels_of([1, 2, 9])
    found = FinalSurfels(
        frames=np.array([7]),
        T_world_camera=np.eye(4)[None],
        segments=np.zeros(5, np.int64),
        ids=np.array([1, 1, 2, 2, 5]),
        factor_stamps_ns=np.array([0, 100, 50, 200, 0]),
        factors=np.array([1.0, 2.0, 1.1, 1.3, 9.0], np.float32),
    )
    for stamp_ns, first, second in ((25, 1.25, 1.1), (100, 2.0, 1.1 + 0.2 / 3.0), (300, 2.0, 1.3)):
        depths = found.corrected(surfels, stamp_ns).positions[:, 2]
        np.testing.assert_allclose(depths, [first, second, 0.5 * (first + second)], rtol=1e-6)


def surfels_of(ids: list[int]) -> SurfelFrame:
    """A metre in front of the camera."""
    count = len(ids)
    floats = np.ones(count, np.float32)
    return replace(
        SurfelFrame.empty(),
        frame=7,
        lost=False,
        ids=np.array(ids),
        positions=np.tile([0.0, 0.0, 1.0], (count, 1)),
        tangents=np.zeros((count, 3, 2)),
        deformations=np.zeros((count, 3)),
        points_px=np.zeros((count, 2), np.float32),
        **dict.fromkeys(("zncc", "visible", "sigma", "gains", "biases"), floats),
        state=np.zeros(count, np.uint8),
        age=np.zeros(count, np.int32),
        born=np.zeros(count, np.int32),
    )


def test_depths_around_are_exact_on_a_plane_and_refused_across_an_edge() -> None:
    rng = np.random.default_rng(1)
    landmarks = rng.uniform(0.0, 200.0, (400, 2))
    points = rng.uniform(40.0, 160.0, (50, 2))

    def plane(pixels: F64) -> F64:
        return 1.0 / (0.8 + 0.001 * pixels[:, 0] - 0.0005 * pixels[:, 1])

    depths, certain = depths_around(points, landmarks, plane(landmarks))
    assert certain.all()
    np.testing.assert_allclose(depths, plane(points), rtol=2e-3)
    behind = landmarks[:, 0] > 100.0
    edge = np.abs(points[:, 0] - 100.0) < 3.0
    _, certain = depths_around(points, landmarks, np.where(behind, 1.5, 1.0) * plane(landmarks))
    assert edge.any()
    assert not certain[edge].any()
    assert certain[np.abs(points[:, 0] - 100.0) > 40.0].all()
