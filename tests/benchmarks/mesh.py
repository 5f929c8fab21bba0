"""Meshes of the same keyframes beside each other: smoothing and fusion against the truth."""

import time
from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path

import numpy as np

from benchmarks.poisson import poisson_mesh
from benchmarks.table import markdown
from pliant.algorithms.arrays import F64
from pliant.algorithms.geometry import pose_to_matrix, transform
from pliant.algorithms.meshing.mesh_blocks import BlockMesh, TriangleMesh
from pliant.config import Config, recorded_config
from pliant.datasets.base import is_builtin
from pliant.datasets.builtin import builtin_folder
from pliant.errors import ResultError
from pliant.evaluation.recorded_mesh import depth_camera, measure_mesh
from pliant.evaluation.run_evaluation import evaluate_result
from pliant.evaluation.surface_distance import share_within, thin_out
from pliant.evaluation.truth import true_frames
from pliant.fusion.keyframe_spool import KeyframeSpool
from pliant.fusion.mesher import Mesher
from pliant.map_history import MapHistory
from pliant.messages import topics
from pliant.messages.mesh_pieces import joined
from pliant.messages.types import Keyframe, MapUpdate
from pliant.recording.summary import summarise
from pliant.results.folder import RECORDING_NAME
from pliant.results.known_scale import MetricRecording
from pliant.results.mesh_files import meshes_of
from pliant.results.run import read_run
from pliant_services.mesh.command import Meshing, mesh_recording
from pliant_services.nodes.meshing import warm_up

_SMOOTHING = {
    "NLTGV": (),
    "no smoothing": ("data_weight=1e6", "data_sigmas=0", "reweightings=1"),
}
_LIVE = {"keyframes follow the map": "points", "and dense depth": "dense"}
_FIGURES = (
    "covered", "median error", "within 5 %", "with the scale that fits", "normals",
    "F-score (precision, recall)", "triangles",
)  # fmt: skip
_NEAR = ("voxel", "vertices within half of one", "within one", "within two", "triangles")
_STRIDE_PX = 4
"""Every so many pixels of the true depth."""


def measure(result: Path, groundtruth: str, overrides: Sequence[str]) -> Iterator[str]:
    """A table of meshes of one result folder."""
    compared = _Compared(result, groundtruth)
    rows: list[list[str]] = []
    for name, settings in _SMOOTHING.items():
        found = compared.make([*overrides, *(f"meshing.surface.nltgv.{s}" for s in settings)])
        for level in ("fine", "coarse"):
            pieces = meshes_of(found.pieces).get((compared.segment, level))
            if pieces is None or (level == "coarse" and settings):
                continue
            rows.append([f"{name}, {level} TSDF", *compared.figures(joined(pieces))])
    figures = compared.figures(poisson(compared.history))
    rows.append(["Poisson of the points (Open3D)", *figures])
    yield markdown(["mesh", *_FIGURES], rows)


def measure_live(result: Path, groundtruth: str, overrides: Sequence[str]) -> Iterator[str]:
    """A table of the live mesh, of landmarks and of dense depth, and of the final one."""
    compared = _Compared(result, groundtruth)
    warm_up()
    rows: list[list[str]] = []
    for name, depth in _LIVE.items():
        settings = [*overrides, f"meshing.live_depth={depth}"]
        for when, mesh, voxel, *costs in compared.live(settings):
            figures = [*compared.near(mesh, voxel), *compared.figures(mesh)[:-1]]
            rows.append([f"{name}, {when}", *costs, *figures])
    coarse = meshes_of(compared.make(overrides).pieces)[compared.segment, "coarse"]
    mesh = joined(coarse)
    figures = [*compared.near(mesh, coarse[0].voxel_size), *compared.figures(mesh)[:-1]]
    rows.append(["the final coarse mesh", "", "", *figures])
    yield markdown(["coarse mesh", "fusions", "CPU ms a keyframe", *_NEAR, *_FIGURES[:-1]], rows)


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

    def _config(self, overrides: Sequence[str]) -> Config:
        return recorded_config(summarise(self._recording).metadata, overrides)

    def make(self, overrides: Sequence[str]) -> Meshing:
        return mesh_recording(self._recording, self._config(overrides))

    def live(self, overrides: Sequence[str]) -> Iterator[tuple[str, TriangleMesh, float, str, str]]:
        """When, the live mesh of the last segment, its voxels, fusions, and CPU ms a keyframe: at
        the last frame, and as after so many more frames where it was behind the map."""
        recording, held = MetricRecording(self._recording), BlockMesh()
        updates, keyframes = (recording.decoded(t) for t in (topics.MAP_UPDATE, topics.KEYFRAME))
        with KeyframeSpool() as spool:
            mesher = Mesher(self._camera, self._config(overrides).meshing, spool)
            spent, segment, voxel = 0.0, -1, 0.0

            def fuse() -> None:
                nonlocal held, spent, segment, voxel
                begun = time.process_time()
                changes = mesher.fuse()
                spent += time.process_time() - begun
                for change in changes:
                    held = held if change.segment == segment else BlockMesh()
                    held.apply(change.blocks)
                    segment, voxel = change.segment, change.voxel_size

            def row(when: str) -> tuple[str, TriangleMesh, float, str, str]:
                fusions = sum(int(mesher.counts[k]) for k in ("fused", "settled", "again"))
                each_ms = 1e3 * spent / len(spool.keyframes())
                return when, held.mesh(), voxel, str(fusions), f"{each_ms:.0f}"

            for update, keyframe in zip(updates, keyframes, strict=True):
                assert isinstance(update, MapUpdate)
                assert isinstance(keyframe, Keyframe)
                mesher.take(update, keyframe, keyframe.images(), update.frame, keyframe.masks())
                fuse()
            yield row("at the last frame")
            if behind := mesher.behind:
                while mesher.behind:
                    fuse()
                yield row(f"{behind} frames later")

    def near(self, mesh: TriangleMesh, voxel: float) -> list[str]:
        """One of each of _NEAR, for voxels in units of the map."""
        alignment = self._evaluation.final.alignment
        if alignment is None:
            raise ResultError("without an aligned trajectory the mesh has no scale")
        points = alignment.apply(mesh.positions.astype(np.float64))
        voxel_m = alignment.scale * voxel
        true = thin_out(self._true_surface, voxel_m / 8)
        shares = [share_within(points, true, share * voxel_m) for share in (0.5, 1.0, 2.0)]
        figures = [f"{100 * share:.1f} %" for share in shares]
        return [f"{100 * voxel_m:.1f} cm", *figures, str(len(mesh.triangles))]

    @cached_property
    def _true_surface(self) -> F64:
        """(N, 3) of what the keyframes show."""
        frames, parts = true_frames(self._truth), [np.zeros((0, 3))]
        camera = depth_camera(self._truth, self._camera)
        for frame, (segment, _) in self.history.keyframe_poses().items():
            if segment != self.segment:
                continue
            depth, T_world_camera = frames(frame)
            v, u = np.nonzero(depth[::_STRIDE_PX, ::_STRIDE_PX])
            pixels = _STRIDE_PX * np.stack([u, v], axis=1)
            rays = np.column_stack([camera.normalise(pixels.astype(np.float64)), np.ones(len(u))])
            z = depth[pixels[:, 1], pixels[:, 0], None]
            parts.append(transform(T_world_camera, z * rays))
        return np.concatenate(parts)

    def figures(self, mesh: TriangleMesh) -> list[str]:
        """One of each of _FIGURES."""
        found = measure_mesh(
            mesh, self.history, self._camera, self._truth, self._evaluation
        ).result()
        return [
            f"{100 * found.covered:.1f} %",
            f"{100 * found.median_error:.2f} %",
            f"{100 * found.within:.1f} %",
            f"{100 * found.fitted_median_error:.2f} %, {100 * found.fitted_within:.1f} %",
            f"{found.normal_deg:.1f} deg",
            f"{found.f_score:.3f} ({found.precision:.3f}, {found.recall:.3f})",
            str(found.triangles),
        ]


def poisson(history: MapHistory) -> TriangleMesh:
    """Poisson reconstruction of the map's points, with normals towards the nearest keyframe."""
    longest, points = history.longest_segment(), history.points()
    points = points.select(points.segments == longest)
    frames = {k.frame: k.pose_world_camera for k in history.keyframes.values()}
    known = np.array(sorted(frames))
    nearest = known[np.clip(np.searchsorted(known, points.frames), 0, len(known) - 1)]
    poses = pose_to_matrix(np.array([frames[int(frame)] for frame in nearest]))
    vertices, normals, triangles = poisson_mesh(points.positions, poses[:, :3, 3])
    return TriangleMesh(
        positions=vertices, normals=normals, colours=np.zeros((0, 3), np.uint8),
        triangles=triangles,
    )  # fmt: skip
