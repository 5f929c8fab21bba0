"""The rigid built-in sequences: their options, and how their folders are filled."""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import Field

from pliant.algorithms.arrays import F64
from pliant.datasets.sequence_files import (
    Progress,
    render_threads,
    write_sequence,
)
from pliant.errors import DatasetError, ResultError
from pliant.rendering.film import CameraOptions, FilmOptions
from pliant.rendering.lens import NO_DISTORTION, Distortion, pixel_rays
from pliant.rendering.paths import CameraPath, SampledPath, TurnedPath
from pliant.rendering.scenes import SCENES, BuiltinScene

if TYPE_CHECKING:  # they have kernels, and a folder that is there needs none
    from pliant.rendering.face_textures import FaceColours, FaceTexture
    from pliant.rendering.render import SceneGeometry

# Raise it with every change that alters a single pixel: old caches are then passed over.
RENDERER_VERSION = 3

_LOOK_STRIDE = 8  # pixels
_UNSEEN_DETAIL = 0.1
_SURFACE_EVERY = 10  # frames
_SURFACE_STRIDE = 4  # pixels
_SURFACE_GRID_M = 0.01

_AXES = {"yaw": (0.0, 1.0, 0.0), "pitch": (1.0, 0.0, 0.0), "roll": (0.0, 0.0, 1.0)}
_TURN_AT = 0.25  # share of the path, so that a map has started
_TURN_S = 12.0  # a degree in each frame


class SequenceOptions(FilmOptions):
    """Options after the name of a rigid built-in sequence."""

    distortion: Distortion = Field(default=NO_DISTORTION, description="k1,k2,p1,p2 of the lens.")
    colour: bool | None = Field(
        default=None, description="Images in colour, or grey; as the scene is where not given."
    )
    path: str | None = Field(
        default=None, description="TUM file with the camera path, at its own times."
    )
    turn: Literal["yaw", "pitch", "roll"] | None = Field(
        default=None, description="Halt after a quarter of the path for a full turn on the spot."
    )


@dataclass(frozen=True)
class RigidPlan:
    """Everything that a sequence is made of."""

    name: str
    builtin: BuiltinScene
    camera: CameraOptions
    path: CameraPath
    stamps_ns: list[int]
    start_ns: int  # stamp at which the path begins

    def description(self) -> dict[str, Any]:
        """The options and versions that determine every byte of the folder, as JSON."""
        times = [(stamp - self.start_ns) * 1e-9 for stamp in self.stamps_ns]
        poses = np.array([self.path.T_world_camera(time) for time in times])
        return {
            "renderer_version": RENDERER_VERSION,
            "sequence": self.name,
            "frames": len(self.stamps_ns),
            "first_stamp_ns": self.stamps_ns[0],
            "path_sha256": hashlib.sha256(np.round(poses, 9).tobytes()).hexdigest(),
            "camera": self.camera.model_dump(mode="json"),
            "scene": self.builtin.scene.model_dump(mode="json"),
        }

    def render(self, folder: Path, progress: Progress) -> None:
        """Fill an empty folder, but for ``scene.json``."""
        from pliant.rendering.face_textures import make_face, make_face_colours
        from pliant.rendering.render import Renderer, SceneGeometry

        geometry = SceneGeometry(self.builtin.scene)
        with render_threads() as executor:
            seen = _seen_faces(self, geometry)

            def paint(number: int) -> "tuple[FaceTexture, FaceColours | None]":
                detail = 1.0 if number in seen else _UNSEEN_DETAIL
                what = (geometry.scene, geometry.solids, number)
                colours = make_face_colours(*what, detail=detail) if self.camera.colour else None
                return make_face(*what, detail=detail), colours

            textures: list[FaceTexture] = []
            colours: list[FaceColours] = []
            for texture, face_colours in executor.map(paint, range(geometry.n_faces)):
                textures.append(texture)
                colours += [face_colours] if face_colours is not None else []
                progress("painting textures", len(textures), geometry.n_faces)
            renderer = Renderer(geometry, textures, self.path, self.camera, colours or None)
            write_sequence(
                folder,
                f"built-in:{self.name}",
                lambda n: renderer.frame(n, (self.stamps_ns[n] - self.start_ns) * 1e-9),
                self.stamps_ns,
                self.camera,
                self.builtin.scene.depth_scale,
                executor,
                progress,
            )
        _write_surface(folder, self, geometry)


def rigid_plan(name: str, options: SequenceOptions) -> RigidPlan:
    """Check the options against the scene.  Raises DatasetError."""
    builtin = SCENES[name]()
    colour = builtin.colour if options.colour is None else options.colour
    camera = options.camera(builtin.width).model_copy(
        update={"distortion": options.distortion, "colour": colour}
    )
    try:
        pixel_rays(camera.pinhole(), camera.distortion)
    except ValueError as error:
        raise DatasetError(f"built-in:{name}: {error}; choose smaller coefficients") from None
    if options.path is None:
        path, frames = builtin.path, builtin.frames
        if options.turn is not None:
            path = TurnedPath(path, _AXES[options.turn], _TURN_AT * path.duration_s, _TURN_S)
            frames += round(30 * _TURN_S)
        stamps = [i * 1_000_000_000 // 30 for i in range(frames)]
    else:
        path, stamps = _given_path(Path(options.path))
    if options.frames is not None and options.frames > len(stamps):
        raise DatasetError(
            f"built-in:{name}: frames={options.frames}: the path has only {len(stamps)} frames"
        )
    return RigidPlan(name, builtin, camera, path, stamps[: options.frames], stamps[0])


def _given_path(file: Path) -> tuple[CameraPath, list[int]]:
    from pliant.formats.tum import read_tum

    try:
        trajectory = read_tum(file)
    except ResultError as error:
        raise DatasetError(str(error)) from None
    stamps = [int(stamp) for stamp in trajectory.stamps_ns]
    if len(stamps) < 2:
        raise DatasetError(f"{file}: a camera path needs at least 2 poses, got {len(stamps)}")
    times = np.array([(stamp - stamps[0]) * 1e-9 for stamp in stamps], np.float64)
    return SampledPath(times, np.asarray(trajectory.poses, np.float64)), stamps


def _seen_faces(plan: RigidPlan, geometry: "SceneGeometry") -> frozenset[int]:
    """Faces that a coarse look along the path sees.  The others need no fine texture."""
    rays = pixel_rays(plan.camera.pinhole(), plan.camera.distortion)
    rays = np.ascontiguousarray(rays[::_LOOK_STRIDE, ::_LOOK_STRIDE])
    seen: set[int] = set()
    for stamp in plan.stamps_ns:
        T = plan.path.T_world_camera((stamp - plan.start_ns) * 1e-9)
        seen.update(np.unique(geometry.surface(T, rays).faces).tolist())
    return frozenset(seen)


def _write_surface(folder: Path, plan: RigidPlan, geometry: "SceneGeometry") -> None:
    """Points that some frame sees, one in each cell of a grid, with their exact normals."""
    rays = pixel_rays(plan.camera.pinhole(), NO_DISTORTION)
    rays = np.ascontiguousarray(rays[::_SURFACE_STRIDE, ::_SURFACE_STRIDE])
    seen: list[F64] = []
    for stamp in plan.stamps_ns[::_SURFACE_EVERY]:
        T = plan.path.T_world_camera((stamp - plan.start_ns) * 1e-9)
        surface = geometry.surface(T, rays)
        depth = surface.depth_m[:, :, None]
        points = np.concatenate([rays * depth, depth], axis=2) @ T[:3, :3].T + T[:3, 3]
        rows = np.concatenate([points, surface.normals], axis=2)
        seen.append(rows[surface.faces >= 0])
    rows = np.concatenate(seen)
    cells = np.floor((rows[:, :3] - rows[:, :3].min(axis=0)) / _SURFACE_GRID_M).astype(np.int64)
    sizes = cells.max(axis=0) + 1
    _, first = np.unique(np.ravel_multi_index(tuple(cells.T), tuple(sizes)), return_index=True)
    points = rows[np.sort(first)].astype("<f4")
    names = ("x", "y", "z", "nx", "ny", "nz")
    header = "ply\nformat binary_little_endian 1.0\n" + f"element vertex {len(points)}\n"
    header += "".join(f"property float {name}\n" for name in names) + "end_header\n"
    (folder / "surface.ply").write_bytes(header.encode() + points.tobytes())
