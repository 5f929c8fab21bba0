"""Meshes of the same keyframes beside each other: smoothing and fusion against the truth."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from pliant.algorithms.geometry import pose_to_matrix
from pliant.datasets.builtin import builtin_folder, is_builtin
from pliant.errors import ResultError
from pliant.evaluation.mesh_truth import Mesh, MeshTruth
from pliant.evaluation.result import evaluate_result
from pliant.fusion.poisson import poisson_mesh
from pliant.map_history import MapHistory
from pliant.messages.mesh_pieces import joined
from pliant.recording.summary import summarise
from pliant_services.benchmarks.table import markdown
from pliant_services.host import one_thread_each
from pliant_services.mesh_command import mesh_recording
from pliant_services.mesh_results import meshes_of
from pliant_services.mesh_truth import compare_mesh
from pliant_services.replay import recorded_config
from pliant_services.results import RECORDING_NAME, read_run

_SMOOTHING = {
    "NLTGV": "nltgv",
    "Laplacian smoothing": "laplacian",
    "no smoothing": "none",
}


def measure(result: Path, groundtruth: str, overrides: Sequence[str]) -> Iterator[str]:
    """A table of meshes of one result folder."""
    one_thread_each()
    truth = builtin_folder(groundtruth) if is_builtin(groundtruth) else Path(groundtruth)
    evaluation = evaluate_result(result, groundtruth=truth, times=None, frames=None)
    recording = result / RECORDING_NAME
    run = read_run(recording)
    if run.stream is None:
        raise ResultError(f"{result}: the recording has no camera")
    longest = run.history.longest_segment()
    rows: list[list[str]] = []
    for name, kind in _SMOOTHING.items():
        sets = [*overrides, f"meshing.surface.smoothing={kind}"]
        found = mesh_recording(recording, recorded_config(summarise(recording), sets))
        for level in ("fine", "coarse"):
            pieces = meshes_of(found.pieces).get((longest, level))
            if pieces is None or (level == "coarse" and kind != "nltgv"):
                continue
            made = joined(pieces)
            mesh = Mesh(points=made.positions, normals=made.normals, faces=made.triangles)
            compared = compare_mesh(mesh, run.history, run.stream.camera, truth, evaluation)
            rows.append(_row(f"{name}, {level} TSDF", compared))
    mesh = poisson(run.history)
    compared = compare_mesh(mesh, run.history, run.stream.camera, truth, evaluation)
    rows.append(_row("Poisson of the points (Open3D)", compared))
    header = ["mesh", "covered", "median error", "within 5 %", "with the scale that fits"]
    header += ["normals", "F-score", "triangles"]
    yield markdown(header, rows)


def poisson(history: MapHistory) -> Mesh:
    """Poisson reconstruction of the map's points, with normals towards the nearest keyframe."""
    longest, points = history.longest_segment(), history.points()
    points = points.select(points.segments == longest)
    frames = {k.frame: k.pose_world_camera for k in history.keyframes.values()}
    known = np.array(sorted(frames))
    nearest = known[np.clip(np.searchsorted(known, points.frames), 0, len(known) - 1)]
    poses = pose_to_matrix(np.array([frames[int(frame)] for frame in nearest]))
    vertices, normals, triangles = poisson_mesh(points.positions, poses[:, :3, 3])
    return Mesh(points=vertices, normals=normals, faces=triangles)


def _row(name: str, found: MeshTruth) -> list[str]:
    return [
        name,
        f"{100 * found.covered:.1f} %",
        f"{100 * found.median_error:.2f} %",
        f"{100 * found.within:.1f} %",
        f"{100 * found.fitted_median_error:.2f} %, {100 * found.fitted_within:.1f} %",
        f"{found.normal_deg:.1f} deg",
        f"{found.f_score:.3f}",
        str(found.triangles),
    ]
