"""The file of a map that deforms, and its comparison with exact ground truth."""

from pathlib import Path

import numpy as np
import pytest
from breathing_truth import CAMERA, FRAMES, rigid_map, tracks, write_truth

from pliant.algorithms.deformable.held_out import Evidence
from pliant.algorithms.deformable.judged_map import TOO_FEW, doubt, is_evidence
from pliant.evaluation.deforming_map_truth import format_deforming_map, judge_deforming_map
from pliant.evaluation.surface_truth import SurfaceTruth
from pliant.results.deforming_map import adjust_and_write


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> SurfaceTruth:
    return write_truth(tmp_path_factory.mktemp("truth"))


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


def test_a_rigid_scene_has_one_that_hardly_moves(truth: SurfaceTruth, tmp_path: Path) -> None:
    file = tmp_path / "deforming_map.npz"
    assert not adjust_and_write(file, rigid_map(truth), CAMERA, tracks(truth, rigid=True))
    with np.load(file, allow_pickle=False) as content:
        moved, depth = content["displacements"], np.median(content["rest"][:, 2])
    assert np.sqrt((moved**2).sum(axis=2).mean()) < 0.002 * depth


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
    found = doubt(certain, evidence, must_deform=True)
    assert why in found
    assert bool(found) == bool(why)
    assert is_evidence(found) == bool(found)
    assert not is_evidence(TOO_FEW)


def test_a_map_that_need_not_deform_may_be_rigid() -> None:
    assert not doubt(0.8, Evidence(0.99, 0.99, 0.0, 1.0))
