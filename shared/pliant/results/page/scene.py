"""The map of a run as one block of bytes that a browser draws."""

import base64
import json
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, I64, U8, BoolArray
from pliant.algorithms.meshing.decimation import decimated
from pliant.algorithms.meshing.mesh_blocks import TriangleMesh
from pliant.formats.textured import TexturedMesh
from pliant.pictures.map import PATH_COLOUR, PLACES_COLOUR, MapView, choose_view

MAX_POINTS = 40_000
MAX_TRIANGLES = 60_000
_LEVELS = 65535
_QUALITY = 80
_HALF_SLOPES = np.array([4.0 / 3.0, 1.0]) / 2.4
"""To the right and to the upper border of a canvas of 4 to 3, as viewer.js projects."""
_FILLED = 0.92
"""Share of the canvas that is filled at first."""
_RIM = 0.005
"""Share of the points that may lie outside of the box that is drawn, at each side."""


@dataclass(frozen=True)
class MovingMesh:
    """A mesh for each of K key frames, one after the other.

    positions: (V, 3).    colours: (V, 3) RGB.    triangles: (T, 3), seen from both sides.
    first_vertices, first_triangles: (K,) of each key frame.    names, times_s: of the key frames.
    """

    positions: F64
    colours: U8
    triangles: I32
    first_vertices: I64
    first_triangles: I64
    names: list[str]
    times_s: list[float]


@dataclass(frozen=True)
class Scene:
    """header: JSON for viewer.js.    bytes: base64."""

    header: str
    bytes: str


def make_scene(
    points: F64,
    colours: U8,
    T_world_camera: F64,
    mesh: TriangleMesh | TexturedMesh | MovingMesh | None,
    places: F64 | None = None,
    *,
    frame_path: bool = True,
) -> Scene:
    """Points (P, 3), the camera's path (N, 4, 4), N >= 1, and the mesh, as many as a page carries.

    mesh: with a texture, or if it moves, it is shown as it is, else decimated.
    places: (L, 2, 3) lines between what shows one place.    frame_path: whether the path is in view
    at first, or the surface alone, which fills the canvas then.

    Places are 16-bit shares of the box that holds the mesh and all but stray points.
    """
    path = T_world_camera[:, :3, 3]
    cloud = points if len(points) else path
    low, high = np.quantile(cloud, (_RIM, 1.0 - _RIM), axis=0)
    low, high = np.minimum(low, path.min(axis=0)), np.maximum(high, path.max(axis=0))
    size = np.maximum(high - low, 1e-9)
    shown = cloud
    tints: U8 | None = None
    uvs: F32 | None = None
    vertices: F32 | F64 = np.zeros((0, 3), np.float32)
    triangles = np.zeros((0, 3), np.int32)
    if isinstance(mesh, TexturedMesh):
        vertices, triangles, uvs = mesh.positions, mesh.triangles, mesh.uvs
    elif isinstance(mesh, MovingMesh):
        vertices, tints, triangles = mesh.positions, mesh.colours, mesh.triangles
    elif mesh is not None and len(mesh.triangles):
        vertices, tints, triangles = decimated(*_outwards(mesh), MAX_TRIANGLES)
    near = ((vertices >= low - size) & (vertices <= high + size)).all(axis=1)
    inner = near[triangles].all(axis=1)
    triangles = triangles[inner]
    if len(triangles):
        shown = vertices[np.unique(triangles)]
        low, high = np.minimum(low, shown.min(axis=0)), np.maximum(high, shown.max(axis=0))
        size = np.maximum(high - low, 1e-9)
    block = _Block(low, size)
    if mesh is not None and len(mesh.triangles):
        block.add("mesh", vertices, tints, triangles, uvs)
        if isinstance(mesh, MovingMesh):
            block.layers[-1]["keys"] = _keys(mesh, inner)
    inside = ((points >= low) & (points <= high)).all(axis=1)
    step = max(1, -(-int(inside.sum()) // MAX_POINTS))
    block.add("points", points[inside][::step], colours[inside][::step])
    block.add("path", path, np.tile(np.array(PATH_COLOUR, np.uint8), (len(path), 1)), line=True)
    if places is not None and len(places):
        tints = np.tile(np.array(PLACES_COLOUR, np.uint8), (2 * len(places), 1))
        block.add("places", places.reshape(-1, 3), tints, line=True, pairs=True)
    view = choose_view(points, T_world_camera)
    target, distance = _framed(shown, path if frame_path else path[:0], view)
    direction = view.T_world_view[:3, 2]
    up = view.up / np.linalg.norm(view.up)
    level = direction - (direction @ up) * up
    level /= max(float(np.linalg.norm(level)), 1e-9)
    header: dict[str, Any] = {
        "low": low.tolist(),
        "size": size.tolist(),
        "target": target.tolist(),
        "distance": distance,
        "height": float(np.arcsin(np.clip(-direction @ up, -1.0, 1.0))),
        "axes": [np.cross(level, up).tolist(), up.tolist(), level.tolist()],
        "layers": block.layers,
    }
    if isinstance(mesh, TexturedMesh):
        quality = [cv2.IMWRITE_WEBP_QUALITY, _QUALITY]
        _, image = cv2.imencode(".webp", mesh.texture[:, :, ::-1], quality)
        header["texture"] = f"data:image/webp;base64,{base64.b64encode(image.tobytes()).decode()}"
    return Scene(json.dumps(header), base64.b64encode(b"".join(block.parts)).decode())


def _keys(mesh: MovingMesh, kept: BoolArray) -> list[dict[str, Any]]:
    """Where each key frame begins and ends.  kept: (T,) triangles that are shown."""
    triangles = np.concatenate([[0], np.cumsum(kept)])
    firsts = triangles[np.append(mesh.first_triangles, len(kept))].tolist()
    vertices = np.append(mesh.first_vertices, len(mesh.positions)).tolist()
    return [
        {
            "name": name,
            "time": time_s,
            "triangles": firsts[k : k + 2],
            "vertices": vertices[k : k + 2],
        }
        for k, (name, time_s) in enumerate(zip(mesh.names, mesh.times_s, strict=True))
    ]


def _framed(places: F64 | F32, path: F64, view: MapView) -> tuple[F64, float]:
    """Where to look, and from how far away, along a view, so that it is filled by the places
    (N, 3), but for stray ones, and by the path (M, 3)."""
    R, target = view.T_world_view[:3, :3], view.centre
    distance = float(np.linalg.norm(view.T_world_view[:3, 3] - target))
    if not len(path):  # the view was chosen with it, and may look past what is to be seen
        low, high = np.quantile(places, (_RIM, 1.0 - _RIM), axis=0)
        target = 0.5 * (low + high)
        distance = 2.0 * max(float(np.linalg.norm(high - low)), 1e-9)
    for _ in range(8):
        seen: list[F64] = []
        for some, rim in ((places, _RIM), (path, 0.0)):
            local = (some - target) @ R + (0.0, 0.0, distance)
            ahead = local[local[:, 2] > 0.1 * distance]
            if len(ahead):
                seen.append(np.quantile(ahead[:, :2] / ahead[:, 2:], (rim, 1.0 - rim), axis=0))
        if not seen:
            break
        low, high = np.min(seen, axis=0)[0], np.max(seen, axis=0)[1]
        target = target + distance * R[:, :2] @ (0.5 * (low + high))
        too_wide = float(np.max((high - low) / (2.0 * _FILLED * _HALF_SLOPES)))
        distance *= min(max(too_wide, 0.5), 2.0)
    return target, distance


class _Block:
    """Arrays one after the other, each at a multiple of four bytes."""

    def __init__(self, low: F64, size: F64) -> None:
        self.parts: list[bytes] = []
        self.layers: list[dict[str, Any]] = []
        self._low, self._size = low, size
        self._length = 0

    def add(
        self, name: str, places: F64 | F32, colours: U8 | None, triangles: I32 | None = None,
        uvs: F32 | None = None, line: bool = False, pairs: bool = False,
    ) -> None:  # fmt: skip
        shares = np.clip((places - self._low) / self._size, 0.0, 1.0)
        layer: dict[str, Any] = {"name": name, "count": len(places), "line": line}
        layer |= {"pairs": True} if pairs else {}
        layer["places"] = self._put(np.round(_LEVELS * shares).astype("<u2").tobytes())
        if colours is not None:
            layer["colours"] = self._put(np.ascontiguousarray(colours, np.uint8).tobytes())
        if uvs is not None:
            layer["uvs"] = self._put(np.round(_LEVELS * uvs).astype("<u2").tobytes())
        if triangles is not None:
            layer["triangles"] = len(triangles)
            layer["indices"] = self._put(triangles.astype("<u4").tobytes())
        self.layers.append(layer)

    def _put(self, data: bytes) -> int:
        at = self._length
        data += bytes(-len(data) % 4)
        self.parts.append(data)
        self._length += len(data)
        return at


def _outwards(mesh: TriangleMesh) -> tuple[F32, U8, I32]:
    """Vertices, colours and triangles whose corners run anticlockwise seen from outside."""
    corners = mesh.positions[mesh.triangles].astype(np.float64)
    turned = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inwards = (turned * mesh.normals[mesh.triangles[:, 0]]).sum(axis=1) < 0.0
    triangles = mesh.triangles.copy()
    triangles[inwards] = triangles[inwards][:, ::-1]
    return mesh.positions, mesh.colours, triangles
