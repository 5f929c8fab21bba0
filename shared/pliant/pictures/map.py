"""A picture of a map: points as shaded splats and the camera's path, without any GUI library."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from pliant.algorithms.arrays import F32, F64, U8, BoolArray
from pliant.algorithms.image.splats import draw_discs

BACKGROUND = (16, 19, 24)
PATH_COLOUR = (255, 150, 40)
PLACES_COLOUR = (90, 220, 110)
"""Colour of lines between keyframes of one place."""
_DOT = 0.008
"""Radius of the dots at their ends, which may coincide, as a share of the picture's rows."""

FOCAL = 1.2  # of the height of the picture
_ASPECT = 4.0 / 3.0
_FROM_DEG = ((25.0, 35.0),)  # azimuth and elevation of the usual view
_FILLED = 0.92  # of the picture, by what it is framed on
_FRAMED_BY, _STOPS = 20_000, 40  # this many points and places of the path are enough
_MOST_UP_DEG, _MOST_DOWN_DEG = 15, 60  # that cameras look, all the time
_HEIGHT_BIN = 0.01  # of the whole extent
_NEAR = 2.0  # medians of the points' distances from the path
_SUPERSAMPLE = 2
# Eye-dome lighting (Boucheny 2009): a pixel is as dark as its neighbours are nearer.
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
    aspect: float = _ASPECT,
    swing_deg: float = 0.0,
) -> MapView:
    """A view from above and behind the camera on most of the map, framed on what there is.

    points: (P, 3).      T_world_camera: (N, 4, 4), N >= 1: up is the mean of the cameras' up, but
    for the angle by which they look down.
    aspect: columns over rows.      swing_deg: they stay in it when it is ``turned`` so far.
    """
    return views_from(points, T_world_camera, _FROM_DEG, aspect=aspect, swing_deg=swing_deg)[0]


def views_from(
    points: F64,
    T_world_camera: F64,
    angles_deg: Iterable[tuple[float, float]],
    *,
    aspect: float = _ASPECT,
    swing_deg: float = 0.0,
    with_path: bool = True,
) -> list[MapView]:
    """As ``choose_view``, one for each azimuth, from the mean viewing direction, and elevation.

    with_path: frame them on the path, too; else on what is near to it.
    """
    up = -T_world_camera[:, :3, 1].mean(axis=0)
    up = _unit(up, np.array([0.0, -1.0, 0.0]))
    forward = T_world_camera[:, :3, 2].mean(axis=0)
    forward = _unit(forward - (forward @ up) * up, _any_normal(up))
    positions = T_world_camera[:, :3, 3]
    up, forward = _levelled(_body(points, positions)[0], up, forward)
    _, radius = _body(points, positions)
    ceiling = float((positions @ up).max()) + 0.25 * radius
    body, radius = _body(points[points @ up <= ceiling], positions)
    if not with_path and len(body) > len(positions):
        body = body[: -len(positions)]
    centre = 0.5 * (body.min(axis=0) + body.max(axis=0))
    swings = np.radians(np.linspace(-swing_deg, swing_deg, 5 if swing_deg else 1))
    body = np.concatenate([(body - centre) @ _about(up, swing).T + centre for swing in swings])
    found: list[MapView] = []
    for azimuth, elevation in angles_deg:
        R = _looking(up, forward, np.radians(azimuth), np.radians(elevation))
        eye = _eye(body, R, aspect)
        away = max(float((centre - eye) @ R[:, 2]), radius)
        middle = eye + away * R[:, 2]
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, middle - away * R[:, 2]
        found.append(
            MapView(T_world_view=T, centre=middle, up=up, ceiling=ceiling, reach=2.3 * away)
        )
    return found


def _looking(up: F64, forward: F64, azimuth: float, elevation: float) -> F64:
    """(3, 3) R_world_view of an eye above, turned by the azimuth away from forward; radians."""
    level = np.cos(azimuth) * forward + np.sin(azimuth) * np.cross(up, forward)
    direction = np.cos(elevation) * level - np.sin(elevation) * up
    right = _unit(np.asarray(np.cross(direction, up), np.float64), _any_normal(up))
    down = np.asarray(np.cross(direction, right), np.float64)
    return np.asarray(np.stack([right, down, direction], axis=1), np.float64)


def turned(view: MapView, angle_deg: float) -> MapView:
    """The view after the eye has gone round what it looks at."""
    T = view.T_world_view.copy()
    R = _about(view.up, np.radians(angle_deg))
    T[:3, :3], T[:3, 3] = R @ T[:3, :3], R @ (T[:3, 3] - view.centre) + view.centre
    return replace(view, T_world_view=T)


def _levelled(body: F64, up: F64, forward: F64) -> tuple[F64, F64]:
    """Up and forward, turned by the angle that the cameras looked down or up: floors and tables
    are level, so that upright most points share a few heights."""
    best, least = 0.0, -np.inf
    # In bins of one size at every angle, or a flatter scene would have finer ones.
    extent = _HEIGHT_BIN * max(float(np.linalg.norm(np.ptp(body, axis=0))), 1e-9)
    for angle in np.radians(np.arange(-_MOST_UP_DEG, _MOST_DOWN_DEG + 1)):
        heights = body @ (np.cos(angle) * up - np.sin(angle) * forward)
        low, high = np.percentile(heights, (2.0, 98.0))
        counts = np.bincount(((np.clip(heights, low, high) - low) / extent).astype(np.int64))
        score = float((counts / len(body)) @ (counts / len(body)))
        if score > least + 1e-9:
            best, least = float(angle), score
    c, s = np.cos(best), np.sin(best)
    return c * up - s * forward, s * up + c * forward


def _about(axis: F64, angle: float) -> F64:
    return np.asarray(cv2.Rodrigues(axis * angle)[0], np.float64)


def _body(points: F64, positions: F64) -> tuple[F64, float]:
    """(N, 3) what the camera has looked at and its path, and their radius; outliers do not count.

    What is far from the whole path, a wall behind the things on a table, is their surroundings.
    """
    cloud = points if len(points) else positions
    cloud = cloud[:: -(-len(cloud) // _FRAMED_BY)]
    low, high = np.percentile(cloud, (2.0, 98.0), axis=0)
    inner = cloud[np.all((cloud >= low) & (cloud <= high), axis=1)]
    stops = positions[:: -(-len(positions) // _STOPS)]
    distances = np.sqrt(((inner[:, None] - stops) ** 2).sum(axis=2).min(axis=1))
    near = inner[distances <= _NEAR * np.median(distances)] if len(inner) else inner
    body = np.concatenate([near, positions])
    centre = 0.5 * (body.min(axis=0) + body.max(axis=0))
    radius = float(np.percentile(np.linalg.norm(body - centre, axis=1), 90.0))
    return body, max(radius, float(np.linalg.norm(positions - centre, axis=1).max()), 1e-6)


def _eye(points: F64, R_world_view: F64, aspect: float) -> F64:
    """The nearest place from which an eye that looks so has all points in the picture.

    Each side of the picture is a plane through the eye; the points push the four outwards.
    """
    local = points @ R_world_view
    middle, depth = np.zeros(3), np.inf
    for axis, share in ((0, aspect), (1, 1.0)):
        slope = _FILLED * 0.5 * share / FOCAL
        least = float((local[:, axis] - slope * local[:, 2]).max())
        most = float((local[:, axis] + slope * local[:, 2]).min())
        middle[axis] = 0.5 * (least + most)
        depth = min(depth, (most - least) / (2.0 * slope))
    middle[2] = depth
    return R_world_view @ middle


def render_map(
    points: F64,
    colours: U8,
    T_world_camera: F64,
    *,
    view: MapView,
    size: tuple[int, int] = (960, 720),
    splat: float = 0.003,
    places: F64 | None = None,
) -> U8:
    """Draw points and the camera's path; returns (height, width, 3) RGB.

    points: (P, 3); those of surfaces that turn away from the eye are left out, so that one looks
    into a room through its walls.      colours: (P, 3) RGB.      T_world_camera: (N, 4, 4), drawn
    as a line with the last camera's pyramid.      size: columns and rows.      splat: radius of a
    point at the middle distance, as a share of the rows.      places: (L, 2, 3) from where one
    place was seen: dots with a line between.
    """
    width, height = size[0] * _SUPERSAMPLE, size[1] * _SUPERSAMPLE
    shown = (points @ view.up <= view.ceiling) & _towards(points, T_world_camera, view)
    px, z = _project(points[shown], view, width, height)
    image, depth = _splat(px, z, colours[shown], (width, height), splat * height, view.reach)
    image = _shade(image, depth, view.reach)
    _draw_path(image, T_world_camera, view)
    if places is not None:
        _draw_places(image, places, view)
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.uint8)


def _unit(vector: F64, otherwise: F64) -> F64:
    length = float(np.linalg.norm(vector))
    return vector / length if length > 1e-9 else otherwise


def _any_normal(vector: F64) -> F64:
    axis = np.eye(3)[int(np.argmin(np.abs(vector)))]
    normal: F64 = np.asarray(np.cross(vector, axis), np.float64)
    return normal / np.linalg.norm(normal)


def _towards(points: F64, T_world_camera: F64, view: MapView) -> BoolArray:
    """(P,) points that the viewer sees from the same side as the nearest camera."""
    positions = T_world_camera[:: -(-len(T_world_camera) // _STOPS) or 1, :3, 3]
    if not len(positions):
        return np.ones(len(points), bool)
    nearest, away = np.full(len(points), np.inf), np.zeros_like(points)
    for position in positions:
        rays = points - position
        square = (rays**2).sum(axis=1)
        closer = square < nearest
        nearest[closer], away[closer] = square[closer], rays[closer]
    return ((points - view.T_world_view[:3, 3]) * away).sum(axis=1) > 0.0


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
    radii = np.clip(radius * 0.55 * reach / np.maximum(z, near), 0.8, 2.0 * radius)
    image = np.empty((height, width, 3), np.float32)
    image[:] = BACKGROUND
    return image, draw_discs(px, z, radii, colours, image)


def dimmed_behind(depth: F32, reach: float) -> F32:
    """(H, W) light that is left where neighbours are nearer than a pixel.

    depth: (H, W), inf where nothing is.      reach: as of a MapView.
    """
    covered = np.isfinite(depth)
    log_depth = np.log(np.where(covered, depth, 1e3 * reach)).astype(np.float32)
    hidden = np.zeros_like(log_depth)
    for du, dv in ((2, 0), (-2, 0), (0, 2), (0, -2), (1, 1), (-1, 1), (1, -1), (-1, -1)):
        neighbour = np.roll(log_depth, (dv, du), axis=(0, 1))
        hidden += np.clip(log_depth - neighbour, 0.0, 0.1)
    return np.exp(-_SHADE / 8.0 * hidden / 0.1)


def _shade(image: F32, depth: F32, reach: float) -> U8:
    covered = np.isfinite(depth)
    light = dimmed_behind(depth, reach)
    fade = np.where(covered, np.exp2(-((depth / reach) ** 2)), 0.0)
    background = np.array(BACKGROUND, np.float32)
    # Grey maps are dim on a dark ground: lift the middle tones.
    bright = 255.0 * (image / 255.0) ** 0.75
    shaded = bright * light[..., None] * fade[..., None] + background * (1.0 - fade[..., None])
    shaded[~covered] = background
    return np.clip(np.round(shaded), 0, 255).astype(np.uint8)


def _draw_line(image: U8, points: F64, view: MapView, colour: tuple[int, int, int]) -> None:
    height, width = image.shape[:2]
    corners, z = _project(points, view, width, height)
    fixed = np.round(corners * (1 << _SHIFT)).astype(np.int32)
    front = z > 1e-9
    # Parts behind the eye interrupt the line.
    for part in np.split(np.arange(len(fixed)), np.flatnonzero(~front)):
        line = fixed[part[front[part]]]
        if len(line) > 1:
            cv2.polylines(image, [line], False, colour, _SUPERSAMPLE + 1, cv2.LINE_AA, _SHIFT)


def _draw_places(image: U8, places: F64, view: MapView) -> None:
    height, width = image.shape[:2]
    for line in places:
        _draw_line(image, line, view, PLACES_COLOUR)
        centres, z = _project(line, view, width, height)
        for u, v in np.round(centres[z > 1e-9] * (1 << _SHIFT)).astype(int).tolist():
            radius = round(_DOT * height * (1 << _SHIFT))
            cv2.circle(image, (u, v), radius, PLACES_COLOUR, cv2.FILLED, cv2.LINE_AA, _SHIFT)


def _draw_path(image: U8, T_world_camera: F64, view: MapView) -> None:
    if not len(T_world_camera):
        return
    _draw_line(image, T_world_camera[:, :3, 3], view, PATH_COLOUR)
    height, width = image.shape[:2]
    size = 0.02 * view.reach
    corners_x, corners_y = np.array([0, -1, 1, 1, -1]), np.array([0, -0.75, -0.75, 0.75, 0.75])
    local = size * np.stack([corners_x, corners_y, np.array([0, 1.3, 1.3, 1.3, 1.3])], axis=1)
    T = T_world_camera[-1]
    pyramid, z = _project(local @ T[:3, :3].T + T[:3, 3], view, width, height)
    if np.all(z > 1e-9):
        p = np.round(pyramid * (1 << _SHIFT)).astype(np.int32)
        lines = [p[[0, i]] for i in (1, 2, 3, 4)] + [p[[1, 2, 3, 4, 1]]]
        cv2.polylines(image, lines, False, (255, 255, 255), _SUPERSAMPLE, cv2.LINE_AA, _SHIFT)
