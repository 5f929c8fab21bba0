"""The pictures of docs/how.md: each step of the method on built-in sequences."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

import pliant
from pliant.algorithms.arrays import F32, F64, U8
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse
from pliant.algorithms.meshing.delaunay import triangulate
from pliant.algorithms.meshing.keyframe_surface import KeyframeSurfaces, SeenPoints
from pliant.algorithms.meshing.parameters import NltgvParameters, SurfaceParameters
from pliant.algorithms.meshing.rendering import normals_of
from pliant.algorithms.tracking.maxima import curvature_and_maxima
from pliant.algorithms.tracking.tracker import ExtremaTracker
from pliant.api.result import Keyframe, Result
from pliant.config import load_config
from pliant.errors import ResultError
from pliant.messages.types import Surfels
from pliant.pictures.overlay import palette
from pliant.viewers.surfel_quads import surfel_picture

RIGID, DEFORMING = "built-in:room", "built-in:objects?frames=90"
_FRAME = 150
_AHEAD = 6
"""Frames between the two pictures of the flow, so that it can be seen."""
_QUALITY = 82
_ENLARGED = 5
_GAP = 8
_FIXED_POINT = 4
_ROUGH = NltgvParameters(data_weight=1e6, data_sigmas=0.0, reweightings=1)
"""Keeps the data as they are."""
_ORANGE, _BLUE, _WHITE = (255, 150, 40), (90, 170, 255), (255, 255, 255)


def draw(rigid: Path, deforming: Path, folder: Path) -> Iterator[str]:
    """Write the pictures; rigid, deforming: result folders of runs of the two sequences.

    Yields what was written.  Raises ResultError for a run that was too short.
    """
    room, objects = pliant.open(rigid), pliant.open(deforming)
    keyframe = next((k for k in room.keyframes if k.frame >= _FRAME), None)
    if keyframe is None:
        raise ResultError(f"{rigid}: has no keyframe from frame {_FRAME} on: {RIGID} has")
    pictures = {
        "extrema": _extrema(_grey(room.image(_FRAME))),
        "flow": _flow(_grey(room.image(_FRAME)), _grey(room.image(_FRAME + _AHEAD))),
        "depth": _depth(room, keyframe),
        "map": _map(room, rigid),
        "surfels": _surfels(objects),
    }
    folder.mkdir(parents=True, exist_ok=True)
    for name, picture in pictures.items():
        path = folder / f"{name}.webp"
        bgr = np.ascontiguousarray(picture[..., ::-1])
        cv2.imwrite(str(path), bgr, [cv2.IMWRITE_WEBP_QUALITY, _QUALITY])
        yield f"{path}: {picture.shape[1]} x {picture.shape[0]}, {path.stat().st_size / 1e3:.0f} kB"


def _extrema(grey: U8) -> U8:
    """A part of the image, and its curvature; the extrema on both."""
    p = load_config().tracking
    _, kappa, _, maxima = curvature_and_maxima(grey, p.blur_sigma_px, p.min_curvature)
    height, width = (side // _ENLARGED for side in grey.shape)
    top, left = 2 * height, 2 * width
    here = maxima[:, :2] - (left, top)
    here = here[((here > 0) & (here < (width - 1, height - 1))).all(axis=1)]
    part = (slice(top, top + height), slice(left, left + width))
    panels = [_rgb(grey[part]), _diverging(kappa[part])]
    for at, colour in ((0, _ORANGE), (1, _WHITE)):
        panels[at] = cv2.resize(
            panels[at], None, fx=_ENLARGED, fy=_ENLARGED, interpolation=cv2.INTER_CUBIC
        )
        for u, v in (here + 0.5) * _ENLARGED - 0.5:
            _dot(panels[at], u, v, colour)
    return _beside(*panels)


def _flow(before: U8, after: U8) -> U8:
    """How a frame lies on a later one as it is, and the motion of every fifth track."""
    tracker = ExtremaTracker(before.shape[1], before.shape[0], load_config().tracking)
    first = tracker.track(before, 0)
    second = tracker.track(after, 1)
    _, one, two = np.intersect1d(first.ids, second.ids, return_indices=True)
    dominant = second.dominant_flow
    A, b = dominant[:, :2], dominant[:, 2]
    carried = cv2.warpAffine(before, dominant, before.shape[::-1])
    there = cv2.warpAffine(np.full_like(before, 255), dominant, before.shape[::-1]) > 0
    left = np.stack([after, carried, carried], axis=-1)
    left[~there] = _rgb(after)[~there] // 2
    right = _rgb(after // 2)
    colours = palette(64)
    for start, end in zip(first.points_px[one][::5], second.points_px[two][::5], strict=True):
        left_over = float(np.linalg.norm(end - (A @ start + b)))
        colour = colours[min(int(3.0 * left_over), len(colours) - 1)]
        cv2.line(right, _fixed(start), _fixed(end), colour, 1, cv2.LINE_AA, _FIXED_POINT)
    return _beside(left, right)


def _depth(room: Result, keyframe: Keyframe) -> U8:
    """Triangles between points; normals as they are and smoothed; the depth."""
    rows, points = room.history.points_of(keyframe.point_ids)
    seen = SeenPoints(
        ids=points.ids,
        points_px=keyframe.points_px[rows],
        points_world=points.positions,
        sigmas=np.asarray(points.sigmas, np.float32),
        keyframes=np.asarray(points.keyframes, np.int32),
    )
    rough, smoothed = (
        _depths_of(room.camera, SurfaceParameters(nltgv=nltgv), keyframe, seen)
        for nltgv in (_ROUGH, SurfaceParameters().nltgv)
    )
    mesh = triangulate(seen.points_px)
    image = keyframe.image
    wire = image.copy()
    lines = [_fixed_all(seen.points_px[mesh.vertices][edge]) for edge in mesh.edges]
    cv2.polylines(wire, lines, False, _ORANGE, 1, cv2.LINE_AA, _FIXED_POINT)
    wire = cv2.addWeighted(wire, 0.5, image, 0.5, 0.0)
    upper = _beside(wire, _inverse_depths(smoothed))
    lower = _beside(*(_normals(depths, room.camera) for depths in (rough, smoothed)))
    return np.concatenate([upper, np.full((_GAP, upper.shape[1], 3), 255, np.uint8), lower])


def _depths_of(
    camera: PinholeCamera, parameters: SurfaceParameters, keyframe: Keyframe, seen: SeenPoints
) -> F32:
    found = KeyframeSurfaces(camera, parameters).surface(keyframe.T_world_camera, seen)
    if found.depth_map is None:
        raise ResultError(f"keyframe {keyframe.id}: {found.problem}")
    return found.depth_map.depths


def _map(room: Result, folder: Path) -> U8:
    """Points with the camera's path, and the mesh."""
    mesh = cv2.imread(str(folder / "mesh.png"))
    if mesh is None:
        raise ResultError(f"{folder}: has no mesh.png")
    height, width = 480, 640
    shown = cv2.resize(mesh, (width, height), interpolation=cv2.INTER_AREA)[..., ::-1]
    points = cv2.resize(room.picture(), (width, height), interpolation=cv2.INTER_AREA)
    return _beside(points, shown)


def _surfels(objects: Result) -> U8:
    """The surfels of the first frame and of the one in which they have moved the most."""
    frames = [surfels for surfels in objects.surfels() if not surfels.missing]
    start = dict(zip(frames[0].ids.tolist(), frames[0].positions, strict=True))

    def moved(surfels: Surfels) -> float:
        pairs = zip(surfels.ids.tolist(), surfels.positions, strict=True)
        return sum(float(np.linalg.norm(at - start[i])) for i, at in pairs if i in start)

    return _beside(*(_with_quads(objects, each) for each in (frames[0], max(frames, key=moved))))


def _with_quads(objects: Result, surfels: Surfels) -> U8:
    picture = surfel_picture(surfels, objects.camera)
    T_camera_world = inverse(surfels.T_world_camera)
    in_camera = picture.quads.positions @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
    corners = objects.camera.project(in_camera).reshape(-1, 4, 2)
    canvas = _rgb(_grey(objects.image(surfels.frame)))
    layer = canvas.copy()
    for quad, colour in zip(corners, picture.colours.tolist(), strict=True):
        cv2.fillPoly(layer, [_fixed_all(quad)], colour, cv2.LINE_AA, _FIXED_POINT)
    return cv2.addWeighted(layer, 0.6, canvas, 0.4, 0.0)


def _beside(left: U8, right: U8) -> U8:
    return np.concatenate([left, np.full((len(left), _GAP, 3), 255, np.uint8), right], axis=1)


def _grey(image: U8) -> U8:
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


def _rgb(grey: U8) -> U8:
    return np.repeat(grey[..., None], 3, axis=-1)


def _diverging(values: F32) -> U8:
    """0 is grey, the largest orange, the smallest blue."""
    share = np.clip(values / np.quantile(np.abs(values), 0.99), -1.0, 1.0)[..., None]
    share = np.sign(share) * np.sqrt(np.abs(share))  # most are small
    ends = np.where(share > 0.0, _ORANGE, _BLUE)
    return np.rint(40 + np.abs(share) * (ends - np.array(40.0))).astype(np.uint8)


def _inverse_depths(depths: F32) -> U8:
    known = depths > 0.0
    values = np.where(known, 1.0 / np.where(known, depths, 1.0), 0.0)
    low, high = np.quantile(values[known], (0.01, 0.99))
    share = np.clip((values - low) / (high - low), 0.0, 1.0)
    shown = cv2.applyColorMap(np.rint(255 * share).astype(np.uint8), cv2.COLORMAP_VIRIDIS)
    return np.where(known[..., None], shown[..., ::-1], 30).astype(np.uint8)


def _normals(depths: F32, camera: PinholeCamera) -> U8:
    normals = normals_of(depths, camera)
    known = normals.any(axis=-1, keepdims=True)
    return np.where(known, np.rint(127.5 * (1.0 - normals)), 30).astype(np.uint8)


def _dot(canvas: U8, u: float, v: float, colour: tuple[int, int, int]) -> None:
    cv2.circle(
        canvas, _fixed((u, v)), 2 << _FIXED_POINT, colour, cv2.FILLED, cv2.LINE_AA, _FIXED_POINT
    )


def _fixed(point: tuple[float, float] | F32 | F64) -> tuple[int, int]:
    u, v = _fixed_all(np.asarray(point)).tolist()
    return u, v


def _fixed_all(points: F32 | F64) -> "np.ndarray[tuple[int, ...], np.dtype[np.int32]]":
    return np.rint(points * (1 << _FIXED_POINT)).astype(np.int32)
