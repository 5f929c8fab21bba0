"""The mesh between surfels in the viewers, during a run."""

from dataclasses import replace
from typing import cast

import numpy as np
from surfel_sheet import surfels_in

from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.meshing.mesh_blocks import TriangleMesh
from pliant.algorithms.surfels.surfel_frame import SurfelState
from pliant.viewers.canvas import Canvas, Moment
from pliant.viewers.scene_surfels import SceneSurfels


class Drawn:
    """Keeps the meshes, and takes everything else."""

    def __init__(self) -> None:
        self.meshes: list[TriangleMesh] = []

    def surface(self, at: Moment, segment: int, mesh: TriangleMesh) -> None:
        self.meshes.append(mesh)

    def __getattr__(self, name: str) -> object:
        return lambda *_: None


def test_the_mesh_follows_its_surfels_and_has_the_colour_of_their_strain() -> None:
    drawn = Drawn()
    scene = SceneSurfels(cast(Canvas, drawn))
    scene.camera = PinholeCamera(width=600, height=600, fx=500, fy=500, cx=300, cy=300)
    frames = [surfels_in(0, 0.0), surfels_in(1, 0.15), surfels_in(2, -0.15)]
    frames.append(replace(frames[2], segment=1))  # begins anew
    frames.append(replace(frames[2], state=np.full(121, SurfelState.LOST, np.uint8)))
    for frame in frames:
        scene.take(Moment(frame.frame, frame.stamp_ns), frame)
    *meshes, nothing = drawn.meshes
    for frame, mesh in zip(frames, meshes, strict=False):
        np.testing.assert_allclose(mesh.positions, frame.positions, rtol=1e-6)
        assert len(mesh.triangles) == 200
    first, stretched, compressed, again = (mesh.colours.astype(int) for mesh in meshes)
    for same in (first, again):
        assert (np.ptp(same, axis=1) < 10).all()
    assert (stretched[:, 0] - stretched[:, 2] > 100).all()
    assert (compressed[:, 2] - compressed[:, 0] > 100).all()
    assert len(nothing.triangles) == 0


def test_a_rolled_camera_and_a_dark_frame_leave_the_strain_as_it_is() -> None:
    drawn = Drawn()
    scene = SceneSurfels(cast(Canvas, drawn))
    scene.camera = PinholeCamera(width=600, height=600, fx=500, fy=500, cx=300, cy=300)
    start, stretched = surfels_in(0, 0.0), surfels_in(1, 0.15)
    # Only one Delaunay triangulation: no four of them are on a circle.
    chance = np.random.default_rng(0).normal(size=(121, 2)).astype(np.float32)
    u, v = (start.points_px - np.float32(300.0) + chance).T
    start = replace(start, points_px=np.stack([u, v], axis=1) + np.float32(300.0))
    dark = replace(start, state=np.full(121, SurfelState.LOST, np.uint8))
    quarters = [(u, v), (-v, u), (-u, -v), (v, -u)]
    rolled = [
        replace(stretched, points_px=np.stack(q, axis=1) + np.float32(300.0)) for q in quarters
    ]
    for frame in (start, dark, *rolled):
        scene.take(Moment(frame.frame, frame.stamp_ns), frame)
    meshes = drawn.meshes[2:]
    assert len({tuple(mesh.triangles[0]) for mesh in meshes}) > 1
    for mesh in meshes:
        assert len(mesh.triangles) > 190
        assert (mesh.colours[:, 0].astype(int) - mesh.colours[:, 2] > 100).all()
