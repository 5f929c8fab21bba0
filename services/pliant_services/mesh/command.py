"""Behind ``pliant mesh``: the final meshes of a recording, made again without a new recording."""

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pliant.algorithms.geometry import pose_to_matrix
from pliant.algorithms.meshing.mesh_blocks import TriangleMesh
from pliant.algorithms.meshing.mesh_components import cleaned
from pliant.config import Config, recorded_config
from pliant.errors import RecordingError
from pliant.export.watertight import WATERTIGHT_NAME, watertight
from pliant.files import write_whole
from pliant.fusion.memory import check_voxel_sizes
from pliant.map_history import MapHistory
from pliant.messages import topics
from pliant.messages.mesh_pieces import joined, split
from pliant.messages.topics import Topic
from pliant.messages.types import CameraStream, Header, MeshPiece, Status
from pliant.open3d_library import load_open3d
from pliant.recording.parts import parts_of
from pliant.recording.summary import summarise
from pliant.results.folder import keep_apart, written
from pliant.results.known_scale import MetricRecording
from pliant.results.mesh_files import (
    MESHED_NAME,
    mesh_of,
    mesh_report,
    meshes_of,
    place_of,
    write_mesh,
    write_meshes,
)
from pliant.results.run import folded_map
from pliant.wording import counted
from pliant_services.processes import BY_NAME
from pliant_services.replay.services import run_on

_MESHING = BY_NAME["meshing"]


@dataclass
class Meshing:
    """The result of meshing a recording.  seconds: total time of each stage."""

    pieces: list[MeshPiece] = field(default_factory=list[MeshPiece])
    seconds: dict[str, float] = field(default_factory=dict[str, float])
    counters: dict[str, float] = field(default_factory=dict[str, float])
    notes: list[str] = field(default_factory=list[str])

    def take(self, topic: Topic, message: Header) -> None:
        """The outputs of the service."""
        if isinstance(message, MeshPiece):
            self.pieces.append(message)
        elif isinstance(message, Status):
            for stage, spent in zip(message.stages, message.seconds.tolist(), strict=True):
                self.seconds[stage] = self.seconds.get(stage, 0.0) + spent
            self.counters.update(zip(message.counters, message.values.tolist(), strict=True))
            if message.note:
                self.notes.append(message.note)


def mesh_recording(recording: Path, config: Config) -> Meshing:
    """Run the meshing service on a recording.

    Raises RecordingError if it has no keyframes; VoxelSizeError before the work starts.
    """
    reader = MetricRecording(recording)
    inputs = {topic: reader.decoded(topic) for topic in _MESHING.inputs}
    known = summarise(recording).topics
    missing = [topic.key for topic in inputs if topic.key not in known]
    if missing:
        raise RecordingError(f"{recording}: has no {missing[0]}: `pliant replay` makes it")
    for stream in reader.decoded(topics.STREAM):
        assert isinstance(stream, CameraStream)
        check_voxel_sizes(stream.camera, config.meshing.tsdf)
    found = Meshing()
    run_on(_MESHING, inputs, config, found.take)
    return found


def run_mesh(
    recording: Path, *, output: Path | None, force: bool, overrides: Sequence[str],
    clean: bool = False, observed: bool = False, close: bool = False,
) -> Iterator[str]:  # fmt: skip
    """Mesh, write the files, and print a summary.  Raises PliantError.

    clean: leave out small pieces.    observed: leave out closed holes.    close: write a watertight
    mesh, too.
    """
    if close:
        load_open3d()  # said before the work
    output = output or _beside(recording.resolve().parent)
    keep_apart(output, [recording, *parts_of(recording)])
    config = recorded_config(summarise(recording).metadata, overrides)
    with written(output, force=force):
        found = mesh_recording(recording, config)
        yield from dict.fromkeys(found.notes)
        if observed:
            found.pieces = list(_changed(found.pieces, TriangleMesh.observed))
        if clean:
            found.pieces = list(_changed(found.pieces, cleaned))
        write_all(output, found, folded_map(recording))
        report = place_of(recording, output) | {
            "mesh": mesh_report(found.pieces),
            "seconds": found.seconds,
            "counters": found.counters,
            "notes": found.notes,
            "config": config.meshing.model_dump(mode="json"),
        }
        write_whole(output / MESHED_NAME, json.dumps(report, indent=1) + "\n")
        if close:
            yield from write_watertight(output, found, folded_map(recording).longest_segment())
    for mesh in mesh_report(found.pieces):
        yield (
            f"segment {mesh['segment']}, {mesh['level']}: "
            f"{counted(mesh['triangles'], 'triangle')}, {mesh['vertices']} vertices, "
            f"voxel {mesh['voxel_size']:.4g}"
        )
    if not found.pieces:
        why = found.notes[-1] if found.notes else "it has no keyframes"
        raise RecordingError(f"{recording}: no mesh: {why}")
    yield f"results in {output}/"


def is_meshed(result: Path, output: Path | None) -> bool:
    """Whether the mesh of a result folder is there, whole: its report is written last."""
    return ((output or _beside(result.resolve())) / MESHED_NAME).exists()


def _beside(folder: Path) -> Path:
    return folder.with_name(f"{folder.name}_mesh")


def _changed(
    pieces: Sequence[MeshPiece], change: Callable[[TriangleMesh], TriangleMesh]
) -> Iterator[MeshPiece]:
    """The meshes, each changed."""
    for some in meshes_of(pieces).values():
        first = some[0]
        yield from split(
            first, change(joined(some)), segment=first.segment, level=first.level,
            voxel_size=first.voxel_size, keyframes=first.keyframes,
        )  # fmt: skip


def write_watertight(output: Path, found: Meshing, segment: int) -> Iterator[str]:
    """The fine mesh of a segment, closed.  Raises ResultError if it does not close."""
    mesh = mesh_of(found.pieces, segment)
    if mesh is not None and len(mesh.triangles):
        closed = watertight(mesh)
        write_mesh(output / WATERTIGHT_NAME, closed)
        yield f"{WATERTIGHT_NAME}: {counted(len(closed.triangles), 'triangle')}"


def write_all(output: Path, found: Meshing, history: MapHistory) -> None:
    """The meshes and pictures of every segment, as the results of a run have them."""
    longest = history.longest_segment()
    for segment in sorted({segment for segment, _ in meshes_of(found.pieces)}):
        poses = [pose for of, pose in history.keyframe_poses().values() if of == segment]
        suffix = "" if segment == longest else f"_segment_{segment}"
        T_world_camera = pose_to_matrix(np.array(poses, np.float64).reshape(-1, 7))
        write_meshes(output, found.pieces, segment, suffix, T_world_camera)
