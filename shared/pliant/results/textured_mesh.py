"""The mesh of a run with a texture from its keyframes."""

from collections.abc import Iterator
from typing import cast

import cv2
import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, U8, BoolArray
from pliant.algorithms.geometry import pose_to_matrix
from pliant.algorithms.image.masks import mask_image, unpacked
from pliant.algorithms.image.sharpness import sharpness
from pliant.algorithms.meshing.decimation import decimated
from pliant.algorithms.meshing.mesh_blocks import TriangleMesh
from pliant.algorithms.meshing.texturing import (
    TexelColours,
    cut_apart,
    find_texels,
    make_atlas,
    patches,
)
from pliant.algorithms.meshing.view_exposure import ExposureSamples
from pliant.formats.textured import TexturedMesh
from pliant.messages import topics
from pliant.messages.types import CameraStream, Keyframe
from pliant.recording.reader import Recording
from pliant.results.run import Run
from pliant.results.still_frames import StillFrames

_EXPOSURE_SAMPLES = 4096
"""Places on the mesh by whose colours keyframes are compared."""
_LEAST_SHARPNESS = 0.1
"""Images without detail, below this, colour only what no other shows.  Sharp: 0.45 to 0.75."""


def textured(
    fine: TriangleMesh, recording: Recording, run: Run, stream: CameraStream, segment: int, *,
    triangles: int, texels: int, views: int | None = None,
) -> TexturedMesh:  # fmt: skip
    """The mesh of a segment of at most that many triangles, with a square texture.

    texels: along a side.    views: of this many keyframes, spread over all; None: of all of them.
    """
    points, tints, faces = decimated(fine.positions, fine.colours, fine.triangles, triangles)
    cut, _ = cut_apart(faces, patches(points[faces]))
    uvs = make_atlas(points[faces], cut, texels)
    on_mesh = find_texels(uvs, texels)
    shown = TexelColours(on_mesh, points, faces)
    still = StillFrames(run, stream.camera, segment)
    camera = still.view.camera
    at = np.linspace(0, len(shown.positions) - 1, _EXPOSURE_SAMPLES).astype(np.int64)
    exposures = ExposureSamples(shown.positions[at], shown.normals[at])

    def seen() -> Iterator[tuple[F64, U8, F32]]:
        for number, image, used in keyframe_images(recording, run, segment, views):
            keyframe = run.history.keyframes[number]
            T_world_camera = pose_to_matrix(keyframe.pose_world_camera)
            view = still.rolled(keyframe.frame) or still.view
            mask = None if used is None else mask_image(used, view.image) > 0
            yield T_world_camera, view.image(image), shown.depths(camera, T_world_camera, mask)

    for T_world_camera, image, depths in seen():
        exposures.add(image, depths, camera, T_world_camera)
    for gain, (T_world_camera, image, depths) in zip(exposures.gains(), seen(), strict=True):
        sharp = sharpness(cast(U8, cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)))
        shown.add(
            image, depths, camera, T_world_camera, gain=gain, sharpness=max(sharp, _LEAST_SHARPNESS)
        )
    unseen = np.rint(on_mesh.interpolate(tints[faces].astype(np.float32))).astype(np.uint8)
    return _with_texture(points, faces, uvs, shown.texture(unseen))


def keyframe_images(
    recording: Recording, run: Run, segment: int, most: int | None = None
) -> Iterator[tuple[int, U8, BoolArray | None]]:
    """Id, (H, W, 3) image and mask (H, W) of each keyframe of a segment that has an image.

    most: of at most this many of its keyframes, spread over all; None: of all.
    """
    here = sorted(n for n, known in run.history.keyframes.items() if known.segment == segment)
    wanted = set(here[:: max(1, -(-len(here) // most))] if most else here)
    for topic in (topics.KEYFRAME, topics.KEYFRAME_FINAL):
        for message in recording.decoded(topic):
            assert isinstance(message, Keyframe)
            masks = message.masks()
            for number, jpeg in message.images().items():
                if number not in wanted or not jpeg:
                    continue
                image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR_RGB)
                if image is not None:
                    used = unpacked(masks[number]) if number in masks else None
                    yield number, np.asarray(image, np.uint8), used


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
