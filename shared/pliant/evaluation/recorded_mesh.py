"""The mesh of a run against the true depth maps of its sequence, at the keyframes."""

from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import pose_to_matrix
from pliant.errors import ResultError
from pliant.evaluation.mesh_truth import Mesh, MeshEvaluation, MeshTruth, format_mesh
from pliant.evaluation.run_evaluation import Evaluation
from pliant.evaluation.truth import true_frames
from pliant.formats.ply import read_ply
from pliant.map_history import MapHistory
from pliant.results.folder import RECORDING_NAME
from pliant.results.run import read_run
from pliant.yaml_text import load_yaml

MESHES = {"mesh": "mesh.ply", "mesh_coarse": "mesh_coarse.ply"}


def mesh_against_truth(
    result: Path, truth: Path, evaluation: Evaluation, figures: dict[str, Any]
) -> Iterator[str]:
    """Both meshes of a result.  Raises ResultError where there is none, or no true depth."""
    if not (result / MESHES["mesh"]).exists():
        raise ResultError(f"{result}: no mesh.ply: run with a mesh, or `pliant mesh {result}`")
    run = read_run(result / RECORDING_NAME)
    if run.stream is None:
        raise ResultError(f"{result}: the recording has no camera")
    for key, name in MESHES.items():
        if (result / name).exists():
            data = read_ply(result / name)
            if data.faces is None or data.normals is None:
                raise ResultError(f"{result / name}: without faces or normals")
            mesh = Mesh(points=data.points, normals=data.normals, faces=data.faces)
            found = compare_mesh(mesh, run.history, run.stream.camera, truth, evaluation)
            figures[key] = asdict(found)
            yield f"{name}:"
            yield format_mesh(found)


def compare_mesh(
    mesh: Mesh,
    history: MapHistory,
    camera: PinholeCamera,
    truth: Path,
    evaluation: Evaluation,
) -> MeshTruth:
    """A mesh in the world of the longest segment, at that segment's keyframes."""
    if truth.is_file():
        truth = truth.parent
    alignment = evaluation.final.alignment
    if alignment is None:
        raise ResultError("without an aligned trajectory the mesh has no scale")
    frames = true_frames(truth)
    measured = MeshEvaluation(mesh, alignment, depth_camera(truth, camera))
    longest = history.longest_segment()
    for frame, (segment, pose) in history.keyframe_poses().items():
        if segment == longest:
            depth, T_true = frames(frame)
            measured.add(depth, T_true, pose_to_matrix(pose))
    return measured.result()


def depth_camera(truth: Path, camera: PinholeCamera) -> PinholeCamera:
    """The camera of the depth maps: ``depth_fx`` and so on, where it is not that of the images."""
    content = load_yaml((truth / "calib.yaml").read_text(encoding="utf-8"))
    names = {name: content.get(f"depth_{name}") for name in ("fx", "fy", "cx", "cy")}
    if all(isinstance(value, int | float) for value in names.values()):
        return replace(camera, **{name: float(value) for name, value in names.items()})
    return camera
