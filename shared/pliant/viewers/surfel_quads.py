"""Surfels as small quads along their frame vectors, coloured by state."""

from dataclasses import dataclass

import numpy as np

from pliant.algorithms.arrays import F32, U8
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.meshing.mesh_blocks import TriangleMesh
from pliant.algorithms.surfels.surfel_frame import SurfelFrame, SurfelState

QUAD_PX = 11.0
"""Side of a quad, in pixels of the image at birth: half the default patch, so that they part."""
FAIR_ZNCC = 0.7
"""Tracked surfels are yellow here and below, and green at 1."""
_YELLOW, _GREEN = np.array([255.0, 210.0, 40.0]), np.array([40.0, 200.0, 90.0])
STATE_COLOURS: dict[SurfelState, tuple[int, int, int]] = {
    SurfelState.OUTLIER: (230, 40, 40),
    SurfelState.OCCLUDED: (170, 90, 230),
    SurfelState.OUTSIDE: (120, 120, 120),
    SurfelState.LOST: (70, 70, 70),
}
_IN_IMAGE = (SurfelState.TRACKED, SurfelState.OUTLIER, SurfelState.OCCLUDED)
_CORNERS = np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
_TRIANGLES = np.array([(0, 1, 2), (0, 2, 3)], np.int32)


@dataclass(frozen=True)
class SurfelPicture:
    """N surfels.

    quads: 4 N vertices, world; normals point to where the camera was at birth.    centres: (N, 3).
    colours: (N, 3) RGB.    points_px, point_colours: (M, 2), (M, 3) of those in the image.
    """

    quads: TriangleMesh
    centres: F32
    colours: U8
    points_px: F32
    point_colours: U8


def surfel_picture(frame: SurfelFrame, camera: PinholeCamera) -> SurfelPicture:
    """The surfels of a frame; those not tracked lie where they were seen well the last time."""
    colours = surfel_colours(frame)
    half = 0.5 * QUAD_PX / np.array([camera.fx, camera.fy])
    corners = (
        frame.positions[:, None] + np.einsum("nij,cj->nci", frame.tangents, _CORNERS * half)
    ).reshape(-1, 3)
    normals = np.cross(frame.tangents[:, :, 1], frame.tangents[:, :, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    first = 4 * np.arange(len(frame.ids), dtype=np.int32)
    quads = TriangleMesh(
        positions=corners.astype(np.float32),
        normals=np.repeat(normals, 4, axis=0).astype(np.float32),
        colours=np.repeat(colours, 4, axis=0),
        triangles=(first[:, None, None] + _TRIANGLES).reshape(-1, 3),
    )
    seen = np.isin(frame.state, _IN_IMAGE)
    return SurfelPicture(
        quads, frame.positions.astype(np.float32), colours, frame.points_px[seen], colours[seen]
    )


def surfel_colours(frame: SurfelFrame) -> U8:
    """(N, 3) RGB: from yellow to green by ZNCC where it is tracked, else by its state."""
    share = np.clip((frame.zncc.astype(np.float64) - FAIR_ZNCC) / (1.0 - FAIR_ZNCC), 0.0, 1.0)
    colours = np.round(_YELLOW + share[:, None] * (_GREEN - _YELLOW)).astype(np.uint8)
    for state, colour in STATE_COLOURS.items():
        colours[frame.state == state] = colour
    return colours
