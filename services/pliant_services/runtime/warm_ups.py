"""Calls every kernel of a service on a small input with the types that it meets.

The first call compiles a kernel, or loads it from the disk: so that the first frame is as quick as
all others.  A service without a row here has no kernels.  Each imports what it calls by itself:
a process loads its own service and no other.
"""

from collections.abc import Callable

import numpy as np

from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.tracks import FrameExtrema, FrameTracks


def _track() -> None:
    """Two frames of noise."""
    from pliant.algorithms.tracking.parameters import TrackingParameters
    from pliant.algorithms.tracking.tracker import ExtremaTracker

    grey = np.random.default_rng(0).integers(0, 256, (120, 160), np.uint8)
    tracker = ExtremaTracker(160, 120, TrackingParameters())
    for _ in range(2):
        tracker.track(grey)


def _map() -> None:
    """Start a map, extend it, lose some tracks and then all, find them again, close a loop."""
    from pliant.algorithms.absolute_pose import pose_by_ransac
    from pliant.algorithms.geometry import so3_exp
    from pliant.algorithms.mapping.loops import Loop
    from pliant.algorithms.mapping.map_store import Keyframe, PointRows
    from pliant.algorithms.mapping.mapper import Mapper
    from pliant.algorithms.mapping.parameters import MappingParameters
    from pliant.algorithms.mapping.self_calibration import SelfCalibration
    from pliant.algorithms.places.features import describe, match
    from pliant.algorithms.places.index import PlaceIndex
    from pliant.algorithms.tracking.maxima import maxima_of
    from pliant.algorithms.tracking.parameters import TrackingParameters

    frames, n = 11, 400
    camera = PinholeCamera(width=320, height=240, fx=300.0, fy=300.0, cx=159.5, cy=119.5)
    generator = np.random.default_rng(0)
    points = generator.uniform((-2.0, -1.5, 3.0), (2.0, 1.5, 8.0), (n, 3))
    kappas = generator.uniform(1.0, 100.0, n).astype(np.float32)
    grey = generator.integers(0, 256, (240, 320), np.uint8)
    colour = np.repeat(grey[:, :, None], 3, axis=2)
    parameters = MappingParameters()
    known = SelfCalibration.of(camera, parameters.calibration).with_readout(0.11, 0.01)
    mapper = Mapper(camera, parameters, seed=0, calibration=known)
    for frame in range(frames):
        step = min(frame, frames - 2)
        turned = points @ so3_exp(np.array([0.0, 0.01 * step, 0.0])).T
        px = camera.project(turned - (0.1 * step, 0.02 * step, 0.0)).astype(np.float32)
        tracked = (np.arange(n) % frames != frame) & (frame < frames - 1)
        tracks = FrameExtrema(
            ids=np.flatnonzero(tracked),
            points_px=px[tracked],
            ages=np.full(int(tracked.sum()), frame, np.int32),
            kappas=kappas[tracked],
            states=np.zeros(int(tracked.sum()), np.uint8),
            maxima=np.column_stack([px, kappas]),
            dominant_flow=np.eye(2, 3),
        )
        mapper.process(frame, 33_333_333 * frame, tracks, grey, colour)
    none = np.zeros((0, 2), np.int64)
    loop = Loop(old=0, new=5, S_old_new=np.eye(4), rows=none.astype(np.int32), ids=none)
    mapper.whole_map.loops.append(loop)
    mapper.finish()
    # What few frames need: a pose that no prediction led to, points that have merged.
    px = camera.project(points).astype(np.float32)
    pose_by_ransac(points, camera.normalise(px), generator, gate=0.1, samples=1)
    keyframe = Keyframe(
        id=0, frame=0, segment=0, T_world_camera=np.eye(4), rows=np.zeros(1, np.int32),
        points_px=px[:1], rolled_px=px[:1],
    )  # fmt: skip
    keyframe.follow_aliases(PointRows())
    maxima_of(grey, TrackingParameters())
    seen, places = describe(grey), PlaceIndex()
    places.add(0, seen)
    places.query(seen)
    match(seen, seen)


def _mesh() -> None:
    """Mesh a keyframe twice, the second time from the first; fuse it and take it out again."""
    from pliant.algorithms.meshing.keyframe_surface import KeyframeSurfaces, SeenPoints
    from pliant.algorithms.meshing.parameters import SurfaceParameters, TsdfParameters
    from pliant.algorithms.meshing.tsdf_volume import TsdfVolume

    n = 100
    camera = PinholeCamera(width=64, height=48, fx=60.0, fy=60.0, cx=31.5, cy=23.5)
    generator = np.random.default_rng(0)
    points_px = generator.uniform((0.0, 0.0), (64.0, 48.0), (n, 2)).astype(np.float32)
    rays = np.concatenate([camera.normalise(points_px), np.ones((n, 1))], axis=1)
    points = SeenPoints(
        ids=np.arange(n, dtype=np.int64),
        points_px=points_px,
        points_world=rays * generator.uniform(2.0, 2.1, (n, 1)),
        sigmas=np.full(n, 0.01, np.float32),
        keyframes=np.full(n, 9, np.int32),
    )
    surfaces, pose = KeyframeSurfaces(camera, SurfaceParameters()), np.eye(4)
    surfaces.surface(pose, points)
    found = surfaces.surface(pose, points).depth_map
    assert found is not None
    volume = TsdfVolume(0.1, TsdfParameters())
    colour = np.zeros((camera.height, camera.width, 3), np.uint8)
    done = volume.integrate(found.depths, found.weights, colour, camera, pose)
    volume.extract_all()
    keys = volume.remove(done.serial, found.depths, found.weights, colour, camera, pose)
    volume.extract(volume.affected(keys))


def _follow_surfels() -> None:
    """Follow a few through two small images, with a camera that stands and one that moves."""
    from pliant.algorithms.surfels.parameters import SurfelParameters
    from pliant.algorithms.surfels.prediction import predict
    from pliant.algorithms.surfels.surfel_tracker import SurfelTracker

    camera = PinholeCamera(width=96, height=72, fx=90.0, fy=90.0, cx=47.5, cy=35.5)
    image = np.random.default_rng(0).integers(0, 200, (72, 96), np.uint8)
    depth, nothing = np.ones((72, 96)), FrameTracks.empty()
    still = SurfelParameters(camera="static", max_surfels=20)
    for parameters in (still, still.model_copy(update={"camera": "moving"})):
        tracker = SurfelTracker(parameters)
        first = tracker.start(image, depth, camera)
        tracker.track(image, predict(first.points_px, nothing, nothing), depth)


WARM_UPS: dict[str, Callable[[], None]] = {
    "tracking": _track,
    "bundle_adjustment": _map,
    "meshing": _mesh,
    "surfels": _follow_surfels,
}
"""By the name of the service."""
