"""The file of a map that deforms, and its comparison with exact ground truth."""

from pathlib import Path

import numpy as np
import pytest

from pliant.algorithms.arrays import F64, I64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.deformable.held_out import Evidence
from pliant.algorithms.deformable.judged_map import doubt
from pliant.algorithms.geometry import inverse, matrix_to_pose, so3_exp, transform
from pliant.evaluation.deforming_map_truth import format_deforming_map, judge_deforming_map
from pliant.evaluation.surface_truth import MaterialPoints, SurfaceTruth
from pliant.formats.tum import write_tum
from pliant.map_history import FramePose, Keyframe, MapHistory
from pliant.rendering.deforming_scenes import BreathingOptions, deforming_scene
from pliant.results.deforming_map import adjust_and_write
from pliant.trajectory import Trajectory

CAMERA = PinholeCamera(width=640, height=480, fx=525.0, fy=525.0, cx=319.5, cy=239.5)
FRAMES, FPS = 80, 10
STILL = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> SurfaceTruth:
    """The breathing surface before a camera that travels, without images."""
    folder = tmp_path_factory.mktemp("truth")
    scene = deforming_scene("breathing", BreathingOptions(seconds=8.0, travel=0.25))
    times = np.arange(FRAMES) / FPS
    vertices = np.array([scene.sheets[0].shape(time) for time in times], np.float32)
    np.savez(folder / "surfaces.npz", names=np.array(["surface"]), vertices_0=vertices)
    T = np.array([scene.path.T_world_camera(time) for time in times])
    stamps = np.arange(FRAMES, dtype=np.int64) * (1_000_000_000 // FPS)
    write_tum(folder / "groundtruth.txt", Trajectory(stamps_ns=stamps, T_world_camera=T))
    return SurfaceTruth(folder, CAMERA)


def tracks(
    truth: SurfaceTruth, *, rigid: bool = False, still: bool = False
) -> list[tuple[int, I64, F64]]:
    """Material points in view, to a fifth of a pixel.

    rigid: those of the first frame.    still: as the first camera sees them.
    """
    rng = np.random.default_rng(8)
    where = rng.uniform((20.0, 20.0), (130.0, 100.0), (1500, 2))
    points = MaterialPoints(np.zeros(len(where), np.int32), where)
    out: list[tuple[int, I64, F64]] = []
    for frame in range(len(truth)):
        shape = truth.positions(points, 0 if rigid else frame)
        seen = transform(inverse(truth.T_world_camera[0 if still else frame]), shape)
        pixels = CAMERA.project(seen) + 0.2 * rng.standard_normal((len(seen), 2))
        inside = ((pixels > 0.0) & (pixels < (639.0, 479.0))).all(axis=1)
        out.append((frame, np.flatnonzero(inside), pixels[inside]))
    return out


def rigid_map(truth: SurfaceTruth) -> MapHistory:
    """Poses of a map in units of its own: some millimetres and half a degree off."""
    rng = np.random.default_rng(9)
    history = MapHistory()
    for frame, T_true in enumerate(truth.T_world_camera):
        T = inverse(truth.T_world_camera[0]) @ T_true
        T[:3, 3] = 1.7 * (T[:3, 3] + 0.004 * rng.standard_normal(3))
        T[:3, :3] = T[:3, :3] @ so3_exp(0.008 * rng.standard_normal(3))
        history.keyframes[frame] = Keyframe(frame, 0, matrix_to_pose(T))
        history.frames[frame] = FramePose(0, frame, STILL, 100)
        history.stamps_ns[frame] = frame * 1_000_000_000 // FPS
    return history


def test_breathing_within_the_targets(truth: SurfaceTruth, tmp_path: Path) -> None:
    file = tmp_path / "deforming_map.npz"
    assert not adjust_and_write(file, rigid_map(truth), CAMERA, tracks(truth))
    found = judge_deforming_map(file, truth)
    assert found.keyframes == FRAMES // 2  # 0.2 s apart
    assert found.whole < 0.01
    assert found.camera < 0.005
    assert found.surface < 0.005
    assert found.covered > 0.9
    assert found.rest > 1.3 * found.whole
    assert f"{found.landmarks} landmarks" in format_deforming_map(found)
    with np.load(file, allow_pickle=False) as content:
        sizes = {name: content[name].shape for name in content.files}
    K, L, N = found.keyframes, found.landmarks, sizes["nodes"][0]
    assert sizes == {
        "frames": (K,),
        "stamps_ns": (K,),
        "T_world_camera": (K, 4, 4),
        "ids": (L,),
        "rest": (L, 3),
        "nodes": (N, 3),
        "displacements": (K, N, 3),
        "carriers": (L, 4),
        "weights": (L, 4),
        "points_px": (K, L, 2),
    }


def test_equal_tracks_give_equal_bytes(truth: SurfaceTruth, tmp_path: Path) -> None:
    some = [(frame, ids[::2], pixels[::2]) for frame, ids, pixels in tracks(truth)]
    files = [tmp_path / f"{number}.npz" for number in range(2)]
    for file in files:
        assert not adjust_and_write(file, rigid_map(truth), CAMERA, some)
    assert files[0].read_bytes() == files[1].read_bytes()


def test_tracks_that_end_at_once_make_no_map(truth: SurfaceTruth, tmp_path: Path) -> None:
    fresh = [
        (frame, ids + 10_000 * frame, pixels) for frame, ids, pixels in tracks(truth)[: FRAMES // 2]
    ]
    file = tmp_path / "deforming_map.npz"
    assert "too few tracks" in adjust_and_write(file, rigid_map(truth), CAMERA, fresh)
    assert "too few tracks" in adjust_and_write(file, rigid_map(truth), CAMERA, [])
    assert not file.exists()


def test_a_rigid_scene_has_none(truth: SurfaceTruth, tmp_path: Path) -> None:
    file = tmp_path / "deforming_map.npz"
    why = adjust_and_write(file, rigid_map(truth), CAMERA, tracks(truth, rigid=True))
    assert why == "a rigid map predicts its tracks as well, or nearly so"
    assert not file.exists()


def test_a_camera_that_stands_still_determines_none(truth: SurfaceTruth, tmp_path: Path) -> None:
    """The rigid map takes the breathing for a motion of the camera."""
    file = tmp_path / "deforming_map.npz"
    why = adjust_and_write(file, rigid_map(truth), CAMERA, tracks(truth, still=True))
    assert "of its landmarks are certain" in why
    assert not file.exists()


def test_pixels_by_chance_determine_none(truth: SurfaceTruth, tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    chance = [(f, ids, generator.uniform(0.0, 200.0, px.shape)) for f, ids, px in tracks(truth)]
    file = tmp_path / "deforming_map.npz"
    why = adjust_and_write(file, rigid_map(truth), CAMERA, chance)
    assert why == "only 0% of its landmarks are certain"
    assert not file.exists()


@pytest.mark.parametrize(
    ("certain", "evidence", "why"),
    [
        (0.8, Evidence(0.99, 0.95, 0.7, 0.8), ""),
        (0.4, Evidence(0.99, 0.95, 0.7, 0.8), "only 40% of its landmarks are certain"),
        (0.8, Evidence(0.75, 0.50, 0.7, 0.8), "only 75% of the tracks"),
        (0.8, Evidence(0.99, 0.99, 0.0, 1.0), "a rigid map predicts its tracks as well"),
        (0.8, Evidence(0.99, 0.95, 0.7, 0.2), "only 20% of its landmarks hardly move"),
        (0.8, Evidence(float("nan"), 0.95, 0.7, 0.8), "only nan% of the tracks"),
    ],
)
def test_each_doubt_has_its_reason(certain: float, evidence: Evidence, why: str) -> None:
    found = doubt(certain, evidence)
    assert why in found
    assert bool(found) == bool(why)
