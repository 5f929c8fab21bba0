"""A wall and a box before it, as the meshing service is told of them, and what it made of them."""

from collections.abc import Sequence

import cv2
import numpy as np

from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import matrix_to_pose
from pliant.algorithms.meshing.mesh_blocks import BlockMesh, TriangleMesh
from pliant.bus.replay_bus import ReplayBus
from pliant.config import load_config
from pliant.messages import topics
from pliant.messages.topics import Topic
from pliant.messages.types import CameraStream, Header, Keyframe, MapUpdate, MeshPiece, MeshUpdate
from pliant_services.nodes import meshing
from pliant_services.runtime.monitor import SilentMonitor

CAMERA = PinholeCamera(width=160, height=120, fx=140.0, fy=140.0, cx=79.5, cy=59.5)
POINTS = 1500
FRAMES = 6
WINDOW = 2
VOXEL = 0.2
"""Of the coarse mesh: the wall is at 4."""


def stream(mode: str = "lossless") -> CameraStream:
    return CameraStream(
        frame=0, stamp_ns=0, frame_id="camera", source="wall", mode=mode, frames=FRAMES,
        calibration="", width=160, height=120, fx=140.0, fy=140.0, cx=79.5, cy=59.5,
    )  # fmt: skip


def world() -> np.ndarray:
    """Points on a wall at 4 and on a box before it."""
    generator = np.random.default_rng(0)
    x, y = generator.uniform((-3.0, -2.0), (3.0, 2.0), (POINTS, 2)).T
    return np.stack([x, y, np.where(np.abs(x) < 0.7, 3.0, 4.0)], axis=1)


def pose(frame: int) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = 0.15 * frame
    return T


def seen(frame: int) -> tuple[np.ndarray, np.ndarray]:
    local = world() - pose(frame)[:3, 3]
    pixels = CAMERA.project(local)
    inside = np.all((pixels > 0) & (pixels < (159, 119)), axis=1)
    return np.flatnonzero(inside), pixels[inside].astype(np.float32)


def map_update(frame: int, *, last: bool = False) -> MapUpdate:
    none = np.zeros(0, np.int64)
    first = frame == 0
    ids = np.arange(POINTS * first, dtype=np.int64)
    key = np.array([] if last else [frame], np.int64)
    return MapUpdate(
        frame=frame, stamp_ns=frame, frame_id="world", state=1, reason="", segment=0, inliers=0,
        pose_frames=none, pose_segments=none.astype(np.int32), pose_keyframes=none,
        poses_keyframe_camera=np.zeros((0, 7)), pose_inliers=none.astype(np.int32),
        keyframe_ids=key, keyframe_frames=key, keyframe_segments=np.zeros(len(key), np.int32),
        keyframe_poses=matrix_to_pose(pose(frame)[None])[: len(key)],
        point_ids=ids, point_segments=np.zeros(len(ids), np.int32),
        points_world=world()[: len(ids)], point_colours=np.zeros((len(ids), 3), np.uint8),
        point_keyframes=np.full(len(ids), 5, np.int32),
        point_parallax_rad=np.full(len(ids), 0.1, np.float32),
        point_sigmas=np.full(len(ids), 0.01, np.float32), removed_point_ids=none,
        point_hosts=np.zeros(len(ids), np.int64),
    )  # fmt: skip


def keyframe(frame: int, new: int, settled: list[int]) -> Keyframe:
    told = [*settled, *([new] if new >= 0 else [])]
    observed = [seen(number) for number in told]
    image = np.full((120, 160), 40 * max(new, 0), np.uint8)
    return Keyframe(
        frame=frame, stamp_ns=frame, frame_id="camera", new=new,
        keyframe_ids=np.array(told, np.int64),
        settled=np.array([number in settled for number in told], np.bool_),
        counts=np.array([len(ids) for ids, _ in observed], np.int32),
        point_ids=np.concatenate([np.zeros(0, np.int64), *(ids for ids, _ in observed)]),
        points_px=np.concatenate([np.zeros((0, 2), np.float32), *(px for _, px in observed)]),
        jpeg=cv2.imencode(".jpg", image)[1].tobytes() if new >= 0 else b"",
    )  # fmt: skip


Inputs = dict[Topic, list[Header]]


def inputs(mode: str = "lossless") -> Inputs:
    leaving = [[frame - WINDOW] if frame >= WINDOW else [] for frame in range(FRAMES)]
    rest = list(range(FRAMES - WINDOW, FRAMES))
    return {
        topics.STREAM: [stream(mode)],
        topics.MAP_UPDATE: [map_update(frame) for frame in range(FRAMES)],
        topics.KEYFRAME: [keyframe(frame, frame, leaving[frame]) for frame in range(FRAMES)],
        topics.MAP_FINAL: [map_update(FRAMES - 1, last=True)],
        topics.KEYFRAME_FINAL: [keyframe(FRAMES - 1, -1, rest)],
    }


class Notes(SilentMonitor):
    """Keeps what the service says of itself."""

    def __init__(self) -> None:
        self.notes: list[str] = []
        self.counters: dict[str, float] = {}
        self.again: list[float] = []

    def report(self, header: Header, *, note: str = "", **counters: float) -> None:
        self.notes += [note] if note else []
        self.counters = counters
        self.again.append(counters["again"])


def run(
    given: Inputs, monitor: Notes | None = None, settings: Sequence[str] = ()
) -> dict[Topic, list[Header]]:
    bus = ReplayBus(given)
    meshing.run(bus, load_config(None, settings), monitor or Notes())
    return bus.outputs


def final(outputs: dict[Topic, list[Header]], level: str) -> MeshPiece:
    (piece,) = [
        m for m in outputs[topics.MESH_FINAL] if isinstance(m, MeshPiece) and m.level == level
    ]
    return piece


def live(made: dict[Topic, list[Header]], segment: int) -> TriangleMesh:
    """The last mesh that a viewer has of a segment."""
    held = BlockMesh()
    for message in made[topics.MESH_BLOCKS]:
        assert isinstance(message, MeshUpdate)
        if message.segment == segment:
            held.apply(message)
        else:
            held = BlockMesh()
    return held.mesh()
