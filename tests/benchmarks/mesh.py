"""Meshes of the same keyframes beside each other: smoothing and fusion against the truth."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from benchmarks.poisson import poisson_mesh
from benchmarks.table import markdown
from pliant.algorithms.geometry import pose_to_matrix
from pliant.algorithms.meshing.mesh_blocks import TriangleMesh
from pliant.config import recorded_config
from pliant.datasets.base import is_builtin
from pliant.datasets.builtin import builtin_folder
from pliant.errors import ResultError
from pliant.evaluation.mesh_truth import Mesh
from pliant.evaluation.recorded_mesh import compare_mesh
from pliant.evaluation.result import evaluate_result
from pliant.map_history import MapHistory
from pliant.messages.mesh_pieces import joined
from pliant.recording.summary import summarise
from pliant.results.folder import RECORDING_NAME
from pliant.results.mesh import meshes_of
from pliant.results.run import read_run
from pliant_services.mesh.command import Meshing, mesh_recording
from pliant_services.nodes.meshing import warm_up

_SMOOTHING = {
    "NLTGV": "nltgv",
    "Laplacian smoothing": "laplacian",
    "no smoothing": "none",
}
_CORRECTIONS = {
    "live, in the end: a preview until it is settled": "settled",
    "live, in the end: put in again where the map moves it": "moved",
}
_FIGURES = (
    "covered", "median error", "within 5 %", "with the scale that fits", "normals",
    "F-score (precision, recall)", "triangles",
)  # fmt: skip


def measure(result: Path, groundtruth: str, overrides: Sequence[str]) -> Iterator[str]:
    """A table of meshes of one result folder."""
    compared = _Compared(result, groundtruth)
    rows: list[list[str]] = []
    for name, kind in _SMOOTHING.items():
        found = compared.make([*overrides, f"meshing.surface.smoothing={kind}"])
        for level in ("fine", "coarse"):
            pieces = meshes_of(found.pieces).get((compared.segment, level))
            if pieces is None or (level == "coarse" and kind != "nltgv"):
                continue
            rows.append([f"{name}, {level} TSDF", *compared.figures(_mesh(joined(pieces)))])
    figures = compared.figures(poisson(compared.history))
    rows.append(["Poisson of the points (Open3D)", *figures])
    yield markdown(["mesh", *_FIGURES], rows)


def measure_live(result: Path, groundtruth: str, overrides: Sequence[str]) -> Iterator[str]:
    """A table of both ways in which the live mesh can follow the map, and of the final one."""
    compared = _Compared(result, groundtruth)
    warm_up()
    rows: list[list[str]] = []
    for name, kind in _CORRECTIONS.items():
        found = compared.make([*overrides, f"meshing.corrections={kind}"])
        counts = found.counters
        fusions = int(counts["fused"] + counts["settled"] + counts["again"])
        # The last report comes after the final mesh.
        spent = found.cpu_seconds[-2] - found.cpu_seconds[0]
        spent_ms = 1e3 * spent / len(compared.history.keyframes)
        figures = compared.figures(_mesh(found.live.mesh()))
        rows.append([name, str(fusions), f"{spent_ms:.0f}", *figures])
    coarse = meshes_of(found.pieces)[compared.segment, "coarse"]
    rows.append(["the final coarse mesh", "", "", *compared.figures(_mesh(joined(coarse)))])
    yield markdown(["coarse mesh", "fusions", "CPU ms a keyframe", *_FIGURES], rows)


class _Compared:
    """A result, its truth, and meshes made again from its recording."""

    def __init__(self, result: Path, groundtruth: str) -> None:
        self._truth = builtin_folder(groundtruth) if is_builtin(groundtruth) else Path(groundtruth)
        self._evaluation = evaluate_result(result, groundtruth=self._truth, times=None, frames=None)
        self._recording = result / RECORDING_NAME
        run = read_run(self._recording)
        if run.stream is None:
            raise ResultError(f"{result}: the recording has no camera")
        self._camera = run.stream.camera
        self.history = run.history
        self.segment = run.history.longest_segment()

    def make(self, overrides: Sequence[str]) -> Meshing:
        config = recorded_config(summarise(self._recording).metadata, overrides)
        return mesh_recording(self._recording, config)

    def figures(self, mesh: Mesh) -> list[str]:
        """One of each of _FIGURES."""
        found = compare_mesh(mesh, self.history, self._camera, self._truth, self._evaluation)
        return [
            f"{100 * found.covered:.1f} %",
            f"{100 * found.median_error:.2f} %",
            f"{100 * found.within:.1f} %",
            f"{100 * found.fitted_median_error:.2f} %, {100 * found.fitted_within:.1f} %",
            f"{found.normal_deg:.1f} deg",
            f"{found.f_score:.3f} ({found.precision:.3f}, {found.recall:.3f})",
            str(found.triangles),
        ]


def _mesh(made: TriangleMesh) -> Mesh:
    return Mesh(points=made.positions, normals=made.normals, faces=made.triangles)


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
