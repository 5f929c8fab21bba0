"""The mesh of a run with a texture of what its keyframes show, as glTF or OBJ."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, U8, BoolArray
from pliant.algorithms.corrected_view import corrected_view
from pliant.algorithms.geometry import pose_to_matrix
from pliant.algorithms.image.masks import unpacked
from pliant.algorithms.meshing.decimation import decimated
from pliant.algorithms.meshing.texturing import (
    TexelColours,
    cut_apart,
    find_texels,
    make_atlas,
    patches,
)
from pliant.errors import ResultError
from pliant.export.images import make_folder, mask_image
from pliant.export.watertight import cleaned
from pliant.formats.textured import TexturedMesh, write_glb, write_obj
from pliant.messages import topics
from pliant.messages.types import Keyframe, MeshPiece
from pliant.recording.reader import Recording
from pliant.results.mesh_files import mesh_of
from pliant.results.run import Run, read_run

TRIANGLES = 40_000
"""What a mesh is decimated to, unless told otherwise."""
_TEXELS = 2048


def glb(
    recording: Recording, path: Path, folder: Path | None, triangles: int = TRIANGLES,
    clean: bool = False,
) -> None:  # fmt: skip
    """Binary glTF with the texture inside."""
    write_glb(path, textured_mesh(recording, triangles, clean=clean))


def obj(
    recording: Recording, path: Path, folder: Path | None, triangles: int = TRIANGLES,
    clean: bool = False,
) -> None:  # fmt: skip
    """A folder with ``mesh.obj``, ``mesh.mtl`` and ``mesh.png``."""
    mesh = textured_mesh(recording, triangles, clean=clean)
    make_folder(path)
    write_obj(path, mesh)


def textured_mesh(recording: Recording, triangles: int, *, clean: bool = False) -> TexturedMesh:
    """The fine mesh of the longest segment, of at most so many triangles.

    clean: without small pieces.

    Raises ResultError where there is none.
    """
    run = read_run(recording.path)
    segment = run.history.longest_segment()
    pieces = [p for p in recording.decoded(topics.MESH_FINAL) if isinstance(p, MeshPiece)]
    fine = mesh_of(pieces, segment)
    if run.stream is None or fine is None or not len(fine.triangles):
        raise ResultError(f"{recording.path}: there is no mesh in it: run its source again")
    fine = cleaned(fine) if clean else fine
    points, tints, faces = decimated(fine.positions, fine.colours, fine.triangles, triangles)
    cut, _ = cut_apart(faces, patches(points[faces]))
    uvs = make_atlas(points[faces], cut, _TEXELS)
    texels = find_texels(uvs, _TEXELS)
    shown = TexelColours(texels, points, faces)
    view = corrected_view(run.stream.camera, run.correction_of(segment))
    for T_world_camera, image, used in keyframe_images(recording, run, segment):
        seen = None if used is None else mask_image(used, view.image) > 0
        shown.add(view.image(image), view.camera, T_world_camera, seen)
    unseen = np.rint(texels.interpolate(tints[faces].astype(np.float32))).astype(np.uint8)
    return _with_texture(points, faces, uvs, shown.texture(unseen))


def keyframe_images(
    recording: Recording, run: Run, segment: int
) -> Iterator[tuple[F64, U8, BoolArray | None]]:
    """Final pose, (H, W, 3) image and mask (H, W) of each keyframe of a segment that has one."""
    for topic in (topics.KEYFRAME, topics.KEYFRAME_FINAL):
        for message in recording.decoded(topic):
            assert isinstance(message, Keyframe)
            masks = message.masks()
            for number, jpeg in message.images().items():
                known = run.history.keyframes.get(number)
                if known is None or known.segment != segment or not jpeg:
                    continue
                image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR_RGB)
                if image is not None:
                    used = unpacked(masks[number]) if number in masks else None
                    pose = pose_to_matrix(known.pose_world_camera)
                    yield pose, np.asarray(image, np.uint8), used


def _with_texture(points: F32, faces: I32, uvs: F32, texture: U8) -> TexturedMesh:
    """One vertex for each pair of a point and a place in the texture."""
    rows = np.concatenate([faces.reshape(-1, 1).astype(np.float32), uvs.reshape(-1, 2)], axis=1)
    _, first, where = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    corners = points[faces].astype(np.float64)
    turned = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros((len(points), 3))
    for k in range(3):
        np.add.at(normals, faces[:, k], turned)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    source = faces.ravel()[first]
    return TexturedMesh(
        positions=points[source],
        normals=normals[source].astype(np.float32),
        uvs=uvs.reshape(-1, 2)[first],
        triangles=where.reshape(-1, 3).astype(np.int32),
        texture=texture,
    )
