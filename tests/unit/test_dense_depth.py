"""Dense depth of keyframes in two passes: sure pixels beside the map's points, and on disk."""

import dataclasses

import numpy as np
import pytest
from stereo_scene import CAMERA, anchors, pose, true_depth_points, true_inverse, view

from pliant.algorithms.arrays import BoolArray
from pliant.algorithms.geometry import inverse, move_by_similarity, transform
from pliant.algorithms.map_delta import MapMoves
from pliant.algorithms.meshing.keyframe_surface import KeyframeSurfaces, SeenPoints
from pliant.algorithms.meshing.parameters import SurfaceParameters
from pliant.algorithms.stereo.views import DenseDepth
from pliant.fusion.dense_depth import LIVE, DenseDepths
from pliant.fusion.keyframe_spool import KeyframeSpool

STEPS = tuple(range(-6, 12, 2))
NOISE_PX = SurfaceParameters().noise_px


def seen(step: int) -> SeenPoints:
    """Points of the map, 100 of which this keyframe sees."""
    found = anchors(step, count=100, noise=0.002)
    rays = np.concatenate([CAMERA.normalise(found.points_px), np.ones((100, 1))], axis=1)
    return SeenPoints(
        ids=np.arange(100, dtype=np.int64) + 100 * (step + 10),
        points_px=found.points_px.astype(np.float32),
        points_world=transform(pose(step), rays / found.inverse_depths[:, None]),
        sigmas=np.full(100, 0.002 / NOISE_PX, np.float32),
        keyframes=np.full(100, 5, np.int32),
    )


def joined(hidden: BoolArray | None = None, workers: int = 3) -> dict[int, SeenPoints]:
    """What each keyframe sees after both passes.  hidden: (H, W) what masks cover, in all."""
    with KeyframeSpool() as spool:
        dense = DenseDepths(CAMERA, NOISE_PX, spool, workers)
        for step in STEPS:
            shown = np.ones((CAMERA.height, CAMERA.width), np.bool_)
            shown = shown if hidden is None else ~hidden
            dense.take(step, pose(step), true_depth_points(step), view(step).grey, shown)
        dense.sweep((step, seen(step)) for step in STEPS)
        agreements = zip(STEPS, dense.agreed(STEPS), strict=True)
        return {k: dense.with_sure_pixels(k, seen(k), agreed) for k, agreed in agreements}


@pytest.fixture(scope="module")
def found() -> dict[int, SeenPoints]:
    return joined()


def test_sure_pixels_lie_on_the_surface_beside_the_points_of_the_map(
    found: dict[int, SeenPoints],
) -> None:
    for step, points in found.items():
        before = seen(step)
        for field in dataclasses.fields(before):
            np.testing.assert_array_equal(
                getattr(points, field.name)[:100], getattr(before, field.name)
            )
        assert (np.diff(points.ids) > 0).all()
        local = transform(inverse(pose(step)), points.points_world[100:])
        np.testing.assert_allclose(CAMERA.project(local), points.points_px[100:], atol=1e-3)
        u, v = np.rint(points.points_px[100:]).astype(int).T
        error = np.abs(1.0 / local[:, 2] / true_inverse(step)[v, u] - 1.0)
        if step == 2:  # in the middle of its neighbours
            assert len(error) > 100
            assert np.mean(error < 0.03) > 0.95
            # A sigma is one: two thirds lie within it, but for what is no noise.
            within = error < points.sigmas[100:] * NOISE_PX
            assert np.mean(within) > 0.6
    middle = [found[step].ids[100:] for step in (2, 4)]
    assert not set(middle[0].tolist()) & set(middle[1].tolist())


def test_with_sure_pixels_more_of_a_view_is_covered(found: dict[int, SeenPoints]) -> None:
    covered = {}
    for name, points in (("points", seen(2)), ("dense", found[2])):
        surface = KeyframeSurfaces(CAMERA, SurfaceParameters()).surface(pose(2), points)
        assert surface.depth_map is not None
        depths = surface.depth_map.depths
        right = np.abs(depths * true_inverse(2) - 1.0) < 0.02
        covered[name] = float(np.mean(right & (depths > 0.0)))
    assert covered["dense"] > covered["points"] + 0.02


def test_the_same_bytes_with_any_number_of_threads(found: dict[int, SeenPoints]) -> None:
    for step, points in joined(workers=1).items():
        assert points.points_world.tobytes() == found[step].points_world.tobytes()
        assert points.sigmas.tobytes() == found[step].sigmas.tobytes()


def one_by_one(spool: KeyframeSpool) -> DenseDepths:
    """As in the live mesh: each is swept when it comes, from those before it."""
    dense = DenseDepths(CAMERA, NOISE_PX, spool, detail=LIVE)
    shown = np.ones((CAMERA.height, CAMERA.width), np.bool_)
    for step in STEPS:
        dense.take(step, pose(step), true_depth_points(step), view(step).grey, shown)
        dense.add(step, seen(step), lambda _: True)
    return dense


def test_keyframes_swept_one_by_one_have_sure_pixels_on_the_surface() -> None:
    with KeyframeSpool() as spool:
        dense = one_by_one(spool)
        first, last = (
            dense.with_sure_pixels(k, seen(k), dense.agreed_on(k)) for k in (STEPS[0], STEPS[-1])
        )
    assert len(first.ids) == 100  # nothing came before it
    local = transform(inverse(pose(STEPS[-1])), last.points_world[100:])
    u, v = np.rint(last.points_px[100:]).astype(int).T
    error = np.abs(1.0 / local[:, 2] / true_inverse(STEPS[-1])[v, u] - 1.0)
    assert len(error) > 100
    assert np.mean(error < 0.03) > 0.9


def test_sources_that_are_not_usable_are_not_used() -> None:
    with KeyframeSpool() as spool:
        dense = one_by_one(spool)
        dense.add(STEPS[-1], seen(STEPS[-1]), lambda _: False)
        assert dense.agreed_on(STEPS[-1]) is None


def test_depths_move_and_grow_with_the_map() -> None:
    S = np.eye(4)
    S[:3] = [[0.0, -2.0, 0.0, 3.0], [2.0, 0.0, 0.0, -1.0], [0.0, 0.0, 2.0, 0.5]]
    quarter_turn = [3.0, -1.0, 0.5, 0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)]
    moves = MapMoves(keyframe_ids=np.array([STEPS[0]]), moves=np.array([[*quarter_turn, 2.0]]))
    np.testing.assert_allclose(moves.matrices(np.array([STEPS[-1]]))[0], S, atol=1e-12)
    last = STEPS[-1]
    with KeyframeSpool() as spool:
        dense = one_by_one(spool)
        before = dense.with_sure_pixels(last, seen(last), dense.agreed_on(last))
        dense.move(moves)
        after = dense.with_sure_pixels(last, seen(last), dense.agreed_on(last))
    # In single precision a pixel may be sure by a hair.
    assert abs(len(after.ids) - len(before.ids)) <= 0.01 * len(before.ids)
    at = {tuple(px): row for row, px in enumerate(before.points_px[100:].tolist())}
    pairs = [(at[tuple(px)], row) for row, px in enumerate(after.points_px[100:].tolist())
             if tuple(px) in at]  # fmt: skip
    old, new = np.array(pairs).T
    expected = transform(S, before.points_world[100:][old])
    off = np.linalg.norm(after.points_world[100:][new] - expected, axis=1)
    assert np.mean(off < 2e-3) > 0.99
    T = move_by_similarity(S, pose(last))
    local = transform(inverse(T), after.points_world[100:])
    np.testing.assert_allclose(CAMERA.project(local), after.points_px[100:], atol=1e-3)


def test_what_masks_cover_is_no_sure_pixel() -> None:
    hidden = np.zeros((CAMERA.height, CAMERA.width), np.bool_)
    hidden[:, 60:] = True
    for points in joined(hidden).values():
        assert not (points.points_px[100:, 0] >= 60).any()


def test_a_keyframe_alone_or_with_a_broken_pose_keeps_its_points() -> None:
    nowhere = pose(0)
    nowhere[0, 3] = np.nan
    shown = np.ones((CAMERA.height, CAMERA.width), np.bool_)
    with KeyframeSpool() as spool:
        dense = DenseDepths(CAMERA, NOISE_PX, spool)
        dense.take(0, pose(0), true_depth_points(0), view(0).grey, shown)
        dense.take(1, nowhere, true_depth_points(1), view(1).grey, shown)
        dense.take(2, pose(2), np.full((5, 3), np.nan), view(2).grey, shown)
        keyframes = (0, 1, 2, 7)
        dense.sweep((keyframe, seen(0)) for keyframe in keyframes)
        for keyframe, agreed in zip(keyframes, dense.agreed(keyframes), strict=True):
            assert len(dense.with_sure_pixels(keyframe, seen(0), agreed).ids) == 100


def test_depths_on_disk_have_half_precision_at_any_scale() -> None:
    generator = np.random.default_rng(0)
    with KeyframeSpool() as spool:
        for keyframe, unit in enumerate((1e-6, 1.0, 1e6)):
            w = np.float32(unit) * generator.uniform(0.05, 5.0, (6, 8)).astype(np.float32)
            w[0, 0] = 0.0
            depth = DenseDepth(w, generator.uniform(0.0, 1.0, (6, 8)).astype(np.float32))
            spool.put_depth(keyframe, depth)
            again = spool.depth(keyframe)
            np.testing.assert_allclose(again.inverse_depths, w, rtol=6e-4)
            np.testing.assert_allclose(again.confidences, depth.confidences, atol=0.5 / 255 + 1e-6)
        spool.put_depth(9, DenseDepth(np.zeros((6, 8), np.float32), np.zeros((6, 8), np.float32)))
        assert not spool.depth(9).inverse_depths.any()
