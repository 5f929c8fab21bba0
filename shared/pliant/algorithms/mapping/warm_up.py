"""Compiles every kernel of the mapper by mapping a small synthetic scene."""

import numpy as np

from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import so3_exp
from pliant.algorithms.mapping.mapper import Mapper
from pliant.algorithms.mapping.parameters import MappingParameters
from pliant.algorithms.tracks import FrameTracks

_FRAMES, _POINTS = 12, 400


def warm_up() -> None:
    """Start a map, extend it, lose some tracks and find them again, so that all code has run."""
    camera = PinholeCamera(width=320, height=240, fx=300.0, fy=300.0, cx=159.5, cy=119.5)
    generator = np.random.default_rng(0)
    points = generator.uniform((-2.0, -1.5, 3.0), (2.0, 1.5, 8.0), (_POINTS, 3))
    kappas = generator.uniform(1.0, 100.0, _POINTS).astype(np.float32)
    grey = generator.integers(0, 256, (240, 320), np.uint8)
    colour = np.repeat(grey[:, :, None], 3, axis=2)
    mapper = Mapper(camera, MappingParameters(), seed=0)
    for frame in range(_FRAMES):
        turned = points @ so3_exp(np.array([0.0, 0.01 * frame, 0.0])).T
        px = camera.project(turned - (0.1 * frame, 0.02 * frame, 0.0)).astype(np.float32)
        tracked = np.arange(_POINTS) % _FRAMES != frame
        tracks = FrameTracks(
            ids=np.flatnonzero(tracked),
            points_px=px[tracked],
            ages=np.full(int(tracked.sum()), frame, np.int32),
            kappas=kappas[tracked],
            states=np.zeros(int(tracked.sum()), np.uint8),
            maxima=np.column_stack([px, kappas]),
            dominant_flow=np.eye(2, 3),
        )
        mapper.process(frame, tracks, grey, colour)
    mapper.finish()
