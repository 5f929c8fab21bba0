"""A mesh against a scan, and Open3D's figures beside ours."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import so3_exp
from pliant.algorithms.meshing.rendering import view_mesh
from pliant.errors import ResultError
from pliant.evaluation.criteria import Similarity
from pliant.evaluation.evaluate import EvaluationRequest, run_evaluation
from pliant.evaluation.mesh_scan import compare_with_scan, mesh_against_scan
from pliant.evaluation.surface_distance import sample_surface, share_within
from pliant.formats.ply import write_ply
from pliant.open3d_geometry import to_cloud
from pliant.open3d_library import Open3dError, load_open3d


@pytest.fixture(scope="module")
def open3d() -> Any:
    try:
        return load_open3d()
    except Open3dError as error:
        pytest.skip(f"open3d is installed but cannot be loaded ({error})")


def relief(side: int = 80) -> tuple[np.ndarray, np.ndarray]:
    """Points and faces of a surface that no shift, turn or scale leaves alike."""
    x, y = np.meshgrid(np.linspace(0, 4, side), np.linspace(0, 3, side), indexing="ij")
    z = 0.5 * np.sin(2.0 * x) * np.cos(1.7 * y) + 0.2 * np.cos(5.0 * x + y) + 3.0
    points = np.stack([x, y, z], axis=-1).reshape(-1, 3).astype(np.float32)
    a = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    faces = np.concatenate(
        [np.stack([a, a + side, a + 1], 1), np.stack([a + 1, a + side, a + side + 1], 1)]
    )
    return points, faces.astype(np.int32)


@pytest.mark.usefixtures("open3d")
def test_a_mesh_a_little_aside_is_registered_and_its_figures_are_those_of_the_true_one(
    tmp_path: Path,
) -> None:
    points, faces = relief()
    change = Similarity(
        scale=1.02, R=so3_exp(np.array([[0.01, -0.02, 0.015]]))[0], t=np.full(3, 0.03)
    )
    write_ply(
        tmp_path / "mesh.ply",
        change.apply(points.astype(np.float64)).astype(np.float32),
        faces=faces,
    )
    write_ply(tmp_path / "scan.ply", points, faces=faces)
    figures: dict[str, Any] = {}
    still = Similarity(scale=1.0, R=np.eye(3), t=np.zeros(3))
    lines = list(mesh_against_scan(tmp_path, tmp_path / "scan.ply", still, figures))
    found = figures["scan"]
    assert found["registered"] < 0.9
    assert found["scale"] == pytest.approx(1.0 / 1.02, abs=2e-3)
    assert found["turn_deg"] == pytest.approx(
        np.degrees(np.linalg.norm([0.01, 0.02, 0.015])), abs=0.1
    )
    assert found["f_score"] > 0.999
    assert found["chamfer_m"] < 0.25 * 0.01 * found["diameter_m"]
    assert "F-score" in lines[1]


@pytest.mark.usefixtures("open3d")
def test_half_a_mesh_is_precise_and_half_complete() -> None:
    points, faces = relief()
    scan = sample_surface(points.astype(np.float64), faces, 0.02)
    found = compare_with_scan(scan[scan[:, 0] < 2.0], scan, 5.0)
    assert found.precision > 0.999
    assert found.recall == pytest.approx(0.5, abs=0.05)
    assert found.scale == pytest.approx(1.0, abs=2e-3)


def test_our_shares_and_depths_are_open3d_s(open3d: Any) -> None:
    """`pliant eval --mesh` has code of its own, as it has to run where Open3D cannot be loaded."""
    points, faces = relief()
    samples = sample_surface(points.astype(np.float64), faces, 0.05)
    others = samples + np.random.default_rng(1).normal(0.0, 0.04, samples.shape)
    theirs = to_cloud(others, None).compute_point_cloud_distance(to_cloud(samples, None))
    assert share_within(others, samples, 0.05) == pytest.approx(
        float(np.mean(np.asarray(theirs) <= 0.05))
    )
    camera = PinholeCamera(width=160, height=120, fx=150.0, fy=155.0, cx=81.0, cy=58.0)
    T = np.eye(4)
    T[:3, 3] = (2.0, 1.5, -1.0)
    ours = view_mesh(points, faces, camera, T).depths
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(open3d.core.Tensor(points), open3d.core.Tensor(faces.astype(np.uint32)))
    K = np.array([[camera.fx, 0, camera.cx + 0.5], [0, camera.fy, camera.cy + 0.5], [0, 0, 1]])
    rays = scene.create_rays_pinhole(K, np.linalg.inv(T), camera.width, camera.height)
    depths = scene.cast_rays(rays)["t_hit"].numpy()  # these rays have z = 1
    both = np.isfinite(depths) & (ours > 0.0)
    assert (np.isfinite(depths) == (ours > 0.0)).mean() > 0.99
    assert np.median(np.abs(ours[both] / depths[both] - 1.0)) < 1e-5


def test_what_cannot_be_compared_is_said(open3d: Any, tmp_path: Path) -> None:
    still = Similarity(scale=1.0, R=np.eye(3), t=np.zeros(3))
    points, faces = relief(5)
    scan = tmp_path / "scan.ply"
    write_ply(scan, points)
    with pytest.raises(ResultError, match="cannot be placed in the scan"):
        list(mesh_against_scan(tmp_path, scan, None, {}))
    with pytest.raises(ResultError, match=r"no mesh\.ply"):
        list(mesh_against_scan(tmp_path, scan, still, {}))
    write_ply(tmp_path / "mesh.ply", points, faces=faces)
    write_ply(scan, points[:2])
    with pytest.raises(ResultError, match="fewer than three"):
        list(mesh_against_scan(tmp_path, scan, still, {}))


def test_a_missing_scan_or_library_is_said_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    request: dict[str, Any] = {
        "results": [tmp_path],
        "groundtruth": "nowhere",
        "times": None,
        "frames": None,
        "tracks": False,
        "points": False,
        "mesh": False,
        "surfels": False,
        "plot": None,
        "json": None,
    }
    scan = tmp_path / "scan.ply"
    with pytest.raises(ResultError, match="no such scan"):
        list(run_evaluation(EvaluationRequest(**request, scan=scan)))
    scan.touch()
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(Open3dError):
        list(run_evaluation(EvaluationRequest(**request, scan=scan)))
