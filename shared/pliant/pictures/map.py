"""A picture of a map: points as shaded splats and the camera's path, without any GUI library."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from pliant.algorithms.arrays import F32, F64, U8
from pliant.algorithms.image.splats import draw_discs
from pliant.pictures.movie import write_image

BACKGROUND = (16, 19, 24)
PATH_COLOUR = (255, 150, 40)

FOCAL = 1.2  # of the height of the picture
_SUPERSAMPLE = 2
# Eye-dome lighting (Boucheny 2009): a pixel is as dark as its neighbours stand before it.
_SHADE = 6.0
_SHIFT = 4


@dataclass(frozen=True, kw_only=True)
class MapView:
    """Where to look at a map from.  T_world_view: (4, 4), x right, y down, z forward.

    centre: (3,) what it looks at.    reach: distance at which points fade half into the background.
    ceiling: points farther than this along ``up`` are not drawn, so that one can look into a room.
    """

    T_world_view: F64
    centre: F64
    up: F64
    ceiling: float
    reach: float


def choose_view(
    points: F64,
    T_world_camera: F64,
    *,
    azimuth_deg: float = 25.0,
    elevation_deg: float = 35.0,
    distance: float = 1.0,
) -> MapView:
    """A view from above and behind the camera on most of the map.

    points: (P, 3).      T_world_camera: (N, 4, 4), N >= 1: up is the mean of the cameras' up.
    azimuth_deg, elevation_deg: turn about up away from the mean viewing direction, and height.
    distance: 1 shows nine tenths of the points; less is closer.
    """
    up = -T_world_camera[:, :3, 1].mean(axis=0)
    up = _unit(up, np.array([0.0, -1.0, 0.0]))
    forward = T_world_camera[:, :3, 2].mean(axis=0)
    forward = _unit(forward - (forward @ up) * up, _any_normal(up))
    positions = T_world_camera[:, :3, 3]
    _, radius = _body(points, positions)
    ceiling = float((positions @ up).max()) + 0.25 * radius
    centre, radius = _body(points[points @ up <= ceiling], positions)
    turned = np.cos(np.radians(azimuth_deg)) * forward
    turned += np.sin(np.radians(azimuth_deg)) * np.cross(up, forward)
    elevation = np.radians(elevation_deg)
    direction = np.cos(elevation) * turned - np.sin(elevation) * up
    eye = centre - direction * (2.2 * distance * radius)
    right = _unit(np.asarray(np.cross(direction, up), np.float64), _any_normal(up))
    T = np.eye(4)
    T[:3, 0], T[:3, 1], T[:3, 2], T[:3, 3] = right, np.cross(direction, right), direction, eye
    return MapView(T_world_view=T, centre=centre, up=up, ceiling=ceiling, reach=5.0 * radius)


def _body(points: F64, positions: F64) -> tuple[F64, float]:
    """Middle and radius of the path and most of the points; outliers have no say."""
    cloud = points if len(points) else positions
    low, high = np.percentile(cloud, (5.0, 95.0), axis=0)
    inner = cloud[np.all((cloud >= low) & (cloud <= high), axis=1)]
    body = np.concatenate([inner, positions])
    centre = 0.5 * (body.min(axis=0) + body.max(axis=0))
    radius = float(np.percentile(np.linalg.norm(body - centre, axis=1), 90.0))
    return centre, max(radius, float(np.linalg.norm(positions - centre, axis=1).max()), 1e-6)


def render_map(
    points: F64,
    colours: U8,
    T_world_camera: F64,
    *,
    view: MapView,
    size: tuple[int, int] = (960, 720),
    splat: float = 2.0,
) -> U8:
    """Draw points and the camera's path; returns (height, width, 3) RGB.

    points: (P, 3).      colours: (P, 3) RGB.      T_world_camera: (N, 4, 4), drawn as a line with
    the last camera's pyramid.      size: columns and rows.      splat: radius of a point at the
    middle distance, pixels.
    """
    width, height = size[0] * _SUPERSAMPLE, size[1] * _SUPERSAMPLE
    shown = points @ view.up <= view.ceiling
    px, z = _project(points[shown], view, width, height)
    image, depth = _splat(px, z, colours[shown], (width, height), splat * _SUPERSAMPLE, view.reach)
    image = _shade(image, depth, view.reach)
    _draw_path(image, T_world_camera, view)
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.uint8)


def height_colours(points: F64, colours: U8, up: F64) -> U8:
    """(P, 3) RGB: the colours' own brightness, tinted by height, for maps of grey cameras."""
    if not len(points):
        return colours
    heights = points @ up
    low, high = np.percentile(heights, (2.0, 98.0))
    share = np.clip((heights - low) / max(float(high - low), 1e-12), 0.0, 1.0)
    steps = np.round(255.0 * share).astype(np.uint8)[:, None]
    bgr = np.asarray(cv2.applyColorMap(steps, cv2.COLORMAP_VIRIDIS), np.uint8)[:, 0]
    brightness = (0.5 + 0.8 * colours.mean(axis=1) / 255.0)[:, None]
    # Towards white, so that the dark end of the map stays visible on a dark ground.
    tint = 0.75 * bgr[:, ::-1].astype(np.float64) + 0.25 * 255.0
    return np.clip(np.round(tint * brightness), 0, 255).astype(np.uint8)


def write_map_picture(
    path: Path,
    points: F64,
    colours: U8,
    T_world_camera: F64,
    *,
    view: MapView | None = None,
    size: tuple[int, int] = (960, 720),
) -> None:
    """Write a picture of a map; see ``render_map`` and ``choose_view``."""
    view = view or choose_view(points, T_world_camera)
    write_image(path, render_map(points, colours, T_world_camera, view=view, size=size))


def _unit(vector: F64, otherwise: F64) -> F64:
    length = float(np.linalg.norm(vector))
    return vector / length if length > 1e-9 else otherwise


def _any_normal(vector: F64) -> F64:
    axis = np.eye(3)[int(np.argmin(np.abs(vector)))]
    normal: F64 = np.asarray(np.cross(vector, axis), np.float64)
    return normal / np.linalg.norm(normal)


def _project(points: F64, view: MapView, width: int, height: int) -> tuple[F64, F64]:
    T = view.T_world_view
    local = (points - T[:3, 3]) @ T[:3, :3]
    z = local[:, 2]
    safe = np.where(z > 1e-9, z, 1.0)
    px = local[:, :2] / safe[:, None] * (FOCAL * height)
    px += (0.5 * width - 0.5, 0.5 * height - 0.5)
    # Far outside, whole numbers would overflow.
    return np.clip(px, -1e6, 1e6), z


def _splat(
    px: F64, z: F64, colours: U8, size: tuple[int, int], radius: float, reach: float
) -> tuple[F32, F32]:
    """Discs, of which the nearest is seen: image and depth."""
    width, height = size
    near = 0.02 * reach
    front = z > near
    px, z, colours = px[front], z[front], colours[front]
    radii = np.clip(radius * 0.55 * reach / np.maximum(z, near), 0.8, 3.0 * radius)
    image = np.empty((height, width, 3), np.float32)
    image[:] = BACKGROUND
    return image, draw_discs(px, z, radii, colours, image)


def _shade(image: F32, depth: F32, reach: float) -> U8:
    covered = np.isfinite(depth)
    log_depth = np.log(np.where(covered, depth, 1e3 * reach)).astype(np.float32)
    hidden = np.zeros_like(log_depth)
    for du, dv in ((2, 0), (-2, 0), (0, 2), (0, -2), (1, 1), (-1, 1), (1, -1), (-1, -1)):
        neighbour = np.roll(log_depth, (dv, du), axis=(0, 1))
        hidden += np.clip(log_depth - neighbour, 0.0, 0.1)
    light = np.exp(-_SHADE / 8.0 * hidden / 0.1)
    fade = np.where(covered, np.exp2(-((depth / reach) ** 2)), 0.0)
    background = np.array(BACKGROUND, np.float32)
    # Grey maps are dim on a dark ground: lift the middle tones.
    bright = 255.0 * (image / 255.0) ** 0.75
    shaded = bright * light[..., None] * fade[..., None] + background * (1.0 - fade[..., None])
    shaded[~covered] = background
    return np.clip(np.round(shaded), 0, 255).astype(np.uint8)


def _draw_path(image: U8, T_world_camera: F64, view: MapView) -> None:
    if not len(T_world_camera):
        return
    height, width = image.shape[:2]
    corners, z = _project(T_world_camera[:, :3, 3], view, width, height)
    fixed = np.round(corners * (1 << _SHIFT)).astype(np.int32)
    front = z > 1e-9
    # Parts behind the eye interrupt the line.
    for part in np.split(np.arange(len(fixed)), np.flatnonzero(~front)):
        line = fixed[part[front[part]]]
        if len(line) > 1:
            cv2.polylines(image, [line], False, PATH_COLOUR, _SUPERSAMPLE + 1, cv2.LINE_AA, _SHIFT)
    size = 0.02 * view.reach
    corners_x, corners_y = np.array([0, -1, 1, 1, -1]), np.array([0, -0.75, -0.75, 0.75, 0.75])
    local = size * np.stack([corners_x, corners_y, np.array([0, 1.3, 1.3, 1.3, 1.3])], axis=1)
    T = T_world_camera[-1]
    pyramid, z = _project(local @ T[:3, :3].T + T[:3, 3], view, width, height)
    if np.all(z > 1e-9):
        p = np.round(pyramid * (1 << _SHIFT)).astype(np.int32)
        lines = [p[[0, i]] for i in (1, 2, 3, 4)] + [p[[1, 2, 3, 4, 1]]]
        cv2.polylines(image, lines, False, (255, 255, 255), _SUPERSAMPLE, cv2.LINE_AA, _SHIFT)
