"""Scenes with pictures: points of texture, dark frames, films of places."""

from dataclasses import replace

import cv2
import numpy as np
from mapped_scene import Published
from mapping_scene import CAMERA, INTERVAL_NS, Scene, looking

from pliant.algorithms.arrays import F64, U8
from pliant.algorithms.geometry import inverse, transform
from pliant.algorithms.slam.frame import Frame
from pliant.algorithms.slam.mapper import Mapper
from pliant.algorithms.slam.parameters import (
    MappingParameters,
    WholeMapParameters,
    WindowParameters,
)
from pliant.algorithms.tracks import FrameExtrema
from pliant.messages.types import Header, MapKeyframe

_SIDE = 13


def textures(count: int) -> list[np.ndarray]:
    """A square of its own for each point."""
    noise = np.random.default_rng(7).uniform(0, 255, (count, _SIDE, _SIDE)).astype(np.float32)
    return [cv2.GaussianBlur(one, (0, 0), 1.2) for one in noise]


def picture(scene: Scene, squares: list[np.ndarray], T_world_camera: F64) -> U8:
    """The image of the scene: the square of each point where it is seen, near ones in front."""
    points = transform(inverse(T_world_camera), scene.points)
    image = np.full((CAMERA.height, CAMERA.width), 120, np.float32)
    order = np.argsort(-points[:, 2])
    order = order[points[order, 2] >= 0.1]
    corners = CAMERA.project(points[order]) - 0.5 * (_SIDE - 1)
    floors = np.floor(corners)
    fits = (floors >= 0).all(axis=1) & (floors + _SIDE < (CAMERA.width, CAMERA.height)).all(axis=1)
    shift = np.eye(2, 3)
    for i, (x, y), rest in zip(
        order[fits].tolist(),
        floors[fits].astype(int).tolist(),
        (corners - floors)[fits],
        strict=True,
    ):
        shift[:, 2] = rest
        square = cv2.warpAffine(squares[i], shift, (_SIDE, _SIDE), borderMode=cv2.BORDER_REFLECT)
        image[y : y + _SIDE, x : x + _SIDE] = square
    return image.astype(np.uint8)


def dark(_: FrameExtrema) -> tuple[FrameExtrema, U8]:
    """Nothing to be seen."""
    return FrameExtrema.empty(), np.zeros((CAMERA.height, CAMERA.width), np.uint8)


Film = list[tuple[FrameExtrema, np.ndarray]]


def film(scene: Scene, squares: list[np.ndarray], poses: list[F64], cut: int = 0) -> Film:
    """What a camera sees; tracks of another cut are others."""
    images = [picture(scene, squares, T) for T in poses]
    frames = [replace(f, ids=f.ids + 1_000_000 * cut) for f in scene.frames(poses)]
    return list(zip(frames, images, strict=True))


def run(shots: Film, mapper: Mapper | None = None, first: int = 0) -> tuple[Published, Mapper]:
    """Map a film; first: the number of its first frame."""
    mapper, published = mapper or Mapper(CAMERA, MappingParameters(), 0), Published()
    for k, (tracks, grey) in enumerate(shots, first):
        published.apply(mapper.process(Frame(k, k * INTERVAL_NS, tracks, grey)))
        mapper.publish_keyframes()
    return published, mapper


WALL_POINTS = 1150

MERGING = MappingParameters(
    window=WindowParameters(keyframes=5),
    whole_map=WholeMapParameters(growth=0.0, distance_frames=3),
)


def wall(seed=0):
    """A long one, near the camera."""
    generator = np.random.default_rng(seed)
    points = generator.uniform((-4.0, -3.0, 3.0), (16.5, 3.0, 7.0), (WALL_POINTS, 3))
    return Scene(points, generator.uniform(5.0, 500.0, len(points)).astype(np.float32))


def along(first, last, step=0.15):
    """Positions along the wall."""
    count = round(abs(last - first) / step)
    return [looking((x, 0.02 * np.sin(2.0 * x), 0.0)) for x in np.linspace(first, last, count + 1)]


def messages(mapper: Mapper) -> list[MapKeyframe]:
    """The map that is saved of a session."""
    kept = enumerate(mapper.kept())
    return [MapKeyframe.of(Header(frame=n, stamp_ns=0, frame_id="world"), k) for n, k in kept]
