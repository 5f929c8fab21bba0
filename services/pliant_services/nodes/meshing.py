"""Meshing: a dense surface from the keyframes of the map.

in   camera/stream        once
     map/update           every frame
     map/keyframe         every frame: the keyframes that are new or leave the window
     map/final, map/keyframe_final   once, after the last frame
out  mesh/blocks          the blocks of the live mesh that changed
     mesh/final           the meshes of every segment from the final poses, in pieces
"""

from collections.abc import Iterable

import numpy as np

from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.meshing.keyframe_surface import KeyframeSurfaces, SeenPoints
from pliant.algorithms.meshing.parameters import SurfaceParameters, TsdfParameters
from pliant.algorithms.meshing.rendering import DepthMap
from pliant.algorithms.meshing.tsdf_volume import TsdfVolume
from pliant.bus.base import Bus, join, receive, receive_one
from pliant.config import Config
from pliant.fusion.dense_depth import DenseDepths
from pliant.fusion.keyframe_spool import KeyframeSpool
from pliant.fusion.mesher import LiveChange, Mesher
from pliant.messages import topics
from pliant.messages.mesh_pieces import split
from pliant.messages.types import (
    WORLD_FRAME_ID,
    CameraStream,
    Header,
    Keyframe,
    MapUpdate,
    MeshUpdate,
)
from pliant_services.runtime.monitor import Monitor


def run(bus: Bus, config: Config, monitor: Monitor) -> None:
    """Mesh until the map ends."""
    stream = receive_one(bus, topics.STREAM, CameraStream)
    is_live = stream.mode == "live"
    with KeyframeSpool() as spool:
        mesher = Mesher(stream.camera, config.meshing, spool)
        updates = receive(bus, topics.MAP_UPDATE, MapUpdate)
        keyframes = receive(bus, topics.KEYFRAME, Keyframe)
        for update, keyframe in join(updates, keyframes):
            mesher.take(update, keyframe, keyframe.images(), update.frame, keyframe.masks())
            # Live: first all that has come is taken, so that no service waits for the mesh.
            if not (is_live and bus.is_waiting(topics.KEYFRAME)):
                changes = mesher.fuse(newest_only=is_live, timer=monitor.stage)
                _publish(bus, keyframe, changes)
            monitor.report(keyframe, note=mesher.note, **mesher.counts, **mesher.memory)
        last = receive_one(bus, topics.MAP_FINAL, MapUpdate)
        rest = receive_one(bus, topics.KEYFRAME_FINAL, Keyframe)
        mesher.take(last, rest, rest.images(), last.frame, rest.masks())
        for final in mesher.finish(timer=monitor.stage):
            for piece in split(
                last, final.mesh, segment=final.segment, level=final.level,
                voxel_size=final.voxel_size, keyframes=final.keyframes,
            ):  # fmt: skip
                bus.publish(topics.MESH_FINAL, piece)
        monitor.report(last, note=mesher.note, **mesher.counts, **mesher.memory)


def _publish(bus: Bus, header: Header, changes: Iterable[LiveChange]) -> None:
    for change in changes:
        message = MeshUpdate.of(
            header, change.blocks, frame_id=WORLD_FRAME_ID,
            segment=change.segment, voxel_size=change.voxel_size, again=change.again,
            first_key=change.span[0], last_key=change.span[1],
        )  # fmt: skip
        bus.publish(topics.MESH_BLOCKS, message)


def warm_up() -> None:
    """Mesh a keyframe twice, the second time from the first; fuse it and take it out again."""
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
    volume.integrate(found.depths, found.weights, colour, camera, pose)
    volume.extract_finished()
    _warm_up_stereo(camera, points)


def _warm_up_stereo(camera: PinholeCamera, points: SeenPoints) -> None:
    """Sweep two keyframes side by side, check each against the other's depth, and fill with it."""
    grey = np.full((camera.height, camera.width), 128, np.uint8)
    with KeyframeSpool() as spool:
        dense = DenseDepths(camera, SurfaceParameters().noise_px, spool)
        for keyframe in range(2):
            pose = np.eye(4)
            pose[0, 3] = 0.2 * keyframe
            dense.take(keyframe, pose, points.points_world, grey, grey > 0)
        dense.sweep((keyframe, points) for keyframe in range(2))
        (agreed,) = dense.agreed([0])
        dense.with_sure_pixels(0, points, agreed)
        nothing = np.zeros((camera.height, camera.width), np.float32)
        dense.filled(0, DepthMap(nothing, nothing), agreed)
