"""The service that maps the last seconds of a scene that deforms."""

from pathlib import Path

import numpy as np
import pytest
from breathing_truth import CAMERA, FRAMES, STILL, rigid_map, tracks, write_truth
from map_updates import nothing
from restarting import Messages, Restarted, Stopping

from pliant.algorithms.map_delta import LOST, TRACKING
from pliant.algorithms.tracks import FrameTracks
from pliant.bus.replay_bus import ReplayBus
from pliant.config import load_config
from pliant.messages import codec, topics
from pliant.messages.types import CameraStream, DeformingLandmarks, Extrema, Header, MapUpdate
from pliant_services.nodes import deformable_mapping
from pliant_services.runtime.monitor import SilentMonitor

LOST_FROM = 60


def messages(folder: Path) -> Messages:
    """Tracks of a breathing surface, and a rigid map that loses the camera at last."""
    truth = write_truth(folder)
    rigid, seen = rigid_map(truth), tracks(truth)
    out: Messages = {topics.STREAM: [_stream()], topics.EXTREMA: [], topics.MAP_UPDATE: []}
    for frame, ids, pixels in seen:
        header = Header(frame=frame, stamp_ns=rigid.stamps_ns[frame], frame_id="camera")
        count = len(ids)
        found = FrameTracks(
            ids=ids,
            points_px=pixels.astype(np.float32),
            ages=np.zeros(count, np.int32),
            kappas=np.zeros(count, np.float32),
            states=np.zeros(count, np.uint8),
            dominant_flow=np.eye(2, 3),
        )
        lost = frame >= LOST_FROM
        delta = vars(nothing(LOST if lost else TRACKING, "no light" if lost else ""))
        if not lost:
            delta |= {
                "pose_frames": np.array([frame]),
                "pose_segments": np.zeros(1, np.int32),
                "pose_keyframes": np.array([frame]),
                "poses_keyframe_camera": STILL[None],
                "pose_inliers": np.full(1, 100, np.int32),
                "keyframe_ids": np.array([frame]),
                "keyframe_frames": np.array([frame]),
                "keyframe_segments": np.zeros(1, np.int32),
                "keyframe_poses": rigid.keyframes[frame].pose_world_camera[None],
            }
        out[topics.EXTREMA].append(Extrema.of(header, found))
        out[topics.MAP_UPDATE].append(MapUpdate(**vars(header), **delta))
    return out


def _stream() -> CameraStream:
    return CameraStream(
        frame=-1, stamp_ns=0, frame_id="camera", source="breathing", mode="lossless",
        frames=FRAMES, calibration="", width=CAMERA.width, height=CAMERA.height,
        fx=CAMERA.fx, fy=CAMERA.fy, cx=CAMERA.cx, cy=CAMERA.cy,
    )  # fmt: skip


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Messages:
    return messages(tmp_path_factory.mktemp("truth"))


@pytest.fixture(scope="module")
def mapped(inputs: Messages) -> list[Header]:
    bus = ReplayBus(inputs)
    deformable_mapping.run(bus, load_config(), SilentMonitor())
    return bus.outputs[topics.MAP_DEFORMING]


def test_a_message_for_every_frame_and_a_map_every_second(mapped: list[Header]) -> None:
    found = [m for m in mapped if isinstance(m, DeformingLandmarks)]
    assert [m.frame for m in found] == list(range(FRAMES))
    with_map = [m.frame for m in found if len(m.ids)]
    assert with_map == [10, 20, 30, 40, 50]  # then the camera is lost
    assert not any(m.problem for m in found)
    for message in found:
        assert message.frames.tolist()[-1:] == ([message.frame] if len(message.ids) else [])


def test_a_service_that_is_started_again_continues(inputs: Messages, mapped: list[Header]) -> None:
    config, before = load_config(), 31
    kept = Stopping(inputs, before)
    deformable_mapping.run(kept, config, SilentMonitor())
    rest: Messages = {t: m[before + 1 :] for t, m in inputs.items() if t != topics.STREAM}
    again = Restarted({**rest, topics.STREAM: []}, kept.state)
    deformable_mapping.run(again, config, SilentMonitor())
    made = again.outputs[topics.MAP_DEFORMING]
    assert [codec.encode(m) for m in made] == [codec.encode(m) for m in mapped[before + 1 :]]
