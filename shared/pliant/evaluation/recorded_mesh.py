"""The mesh of a run against the true depth maps of its sequence, at the keyframes."""

from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import pose_to_matrix
from pliant.algorithms.meshing.mesh_blocks import TriangleMesh
from pliant.errors import ResultError
from pliant.evaluation.mesh_truth import MeshEvaluation, format_mesh
from pliant.evaluation.presentation import metres
from pliant.evaluation.run_evaluation import Evaluation
from pliant.evaluation.surface_columns import format_columns
from pliant.evaluation.truth import true_frames
from pliant.map_history import MapHistory
from pliant.pictures.caption import with_caption
from pliant.pictures.mesh import draw_mesh, mesh_view
from pliant.pictures.movie import write_image
from pliant.results.folder import MESH_ERROR_NAME, RECORDING_NAME
from pliant.results.mesh_files import read_mesh, run_of
from pliant.results.run import Run, read_run
from pliant.yaml_text import load_yaml

_MOST_ERROR = 0.02
"""Share of the diameter of the scene that is drawn as wholly wrong."""
MESHES = {"mesh": "mesh.ply", "mesh_coarse": "mesh_coarse.ply"}


def mesh_against_truth(
    result: Path, truth: Path, evaluation: Evaluation, figures: dict[str, Any]
) -> Iterator[str]:
    """Both meshes of a run, or of a folder of ``pliant mesh``.

    Raises ResultError if there is none, or no true depth.
    """
    if not (result / MESHES["mesh"]).exists():
        raise ResultError(f"{result}: no mesh.ply: run with a mesh, or `pliant mesh {result}`")
    run = read_run(run_of(result) / RECORDING_NAME)
    if run.stream is None:
        raise ResultError(f"{result}: the recording has no camera")
    for key, name in MESHES.items():
        if (result / name).exists():
            mesh = read_mesh(result / name)
            if mesh is None or not mesh.normals.any():
                raise ResultError(f"{result / name}: without faces or normals")
            measured = measure_mesh(mesh, run.history, run.stream.camera, truth, evaluation)
            found = measured.result()
            figures[key] = asdict(found)
            yield f"{name}:"
            yield format_mesh(found)
            if name == MESHES["mesh"] and (columns := measured.columns()):
                figures["surface"] = {name: asdict(column) for name, column in columns.items()}
                yield format_columns(columns)
                yield _draw_errors(result / MESH_ERROR_NAME, measured, run)


def _draw_errors(path: Path, measured: MeshEvaluation, run: Run) -> str:
    """The mesh, coloured by its distance from the true surface.  Returns a line for the user."""
    distances, diameter = measured.distances(_MOST_ERROR)
    levels = np.rint(255.0 * np.minimum(distances / (_MOST_ERROR * diameter), 1.0))
    turbo = cv2.applyColorMap(levels.astype(np.uint8)[:, None], cv2.COLORMAP_TURBO)
    colours = np.ascontiguousarray(np.asarray(turbo, np.uint8).reshape(-1, 3)[:, ::-1])
    mesh = replace(measured.mesh, colours=colours)
    longest, poses = run.history.longest_segment(), run.history.keyframe_poses().values()
    path_poses = pose_to_matrix(np.array([pose for of, pose in poses if of == longest]))
    picture = draw_mesh(mesh, mesh_view(mesh, path_poses)).colours
    words = f"Distance from the true surface: blue 0, red {metres(_MOST_ERROR * diameter)} or more"
    try:
        write_image(path, with_caption(picture, words))
    except OSError as error:
        return f"{path}: cannot be written ({error.strerror})"
    return f"where the mesh is wrong: {path}"


def measure_mesh(
    mesh: TriangleMesh,
    history: MapHistory,
    camera: PinholeCamera,
    truth: Path,
    evaluation: Evaluation,
) -> MeshEvaluation:
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
    return measured


def depth_camera(truth: Path, camera: PinholeCamera) -> PinholeCamera:
    """The camera of the depth maps: ``depth_fx`` and so on, where it is not that of the images."""
    content = load_yaml((truth / "calib.yaml").read_text(encoding="utf-8"))
    names = {name: content.get(f"depth_{name}") for name in ("fx", "fy", "cx", "cy")}
    if all(isinstance(value, int | float) for value in names.values()):
        return replace(camera, **{name: float(value) for name, value in names.items()})
    return camera
