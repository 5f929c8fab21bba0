"""What `pliant export` makes of a run whose calibration was found wrong."""

import dataclasses
from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from running import in_this_process

from pliant.algorithms.arrays import F64
from pliant.algorithms.map_delta import TRACKING
from pliant.algorithms.tracks import FrameTracks
from pliant.bus.replay_bus import ReplayBus
from pliant.config import Config
from pliant.datasets import open_source
from pliant.export.export import export_result
from pliant.messages import topics
from pliant.messages.types import CameraStream, Extrema, Keyframe, MapUpdate, SourceImage
from pliant.recording.reader import Recording
from pliant_services.nodes import recorder

CORRECTION = (0.05, 0.04, -0.01, 0.0)
"""Of the focal length and the lens: at the corner some 12 px of 160."""


def seen_through_a_wrong_calibration(pinhole: F64) -> F64:
    """(N, 2) points on the plane z = 1 as they lie in the image of ``corrected_run``."""
    s, k1, k2, _ = CORRECTION
    squared = (pinhole**2).sum(axis=1, keepdims=True)
    found = pinhole * np.exp(s) * (1.0 + k1 * squared + k2 * squared**2)
    return found * 100.0 + (79.5, 59.5)


@pytest.fixture(scope="module")
def corrected_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of three keyframes whose last adjustment found the calibration wrong."""
    camera = "model: pinhole\nwidth: 160\nheight: 120\nfx: 100\nfy: 100\ncx: 79.5\ncy: 59.5\n"
    header = {"stamp_ns": 0, "frame_id": ""}
    stream = CameraStream(
        frame=0, **header, source="", mode="lossless", frames=3, calibration=camera, width=160,
        height=120, fx=100.0, fy=100.0, cx=79.5, cy=59.5,
    )  # fmt: skip
    points = np.random.default_rng(0).uniform((-1.2, -0.9, 2.0), (1.2, 0.9, 3.0), (400, 3))
    poses = np.zeros((3, 7))
    poses[:, 0], poses[:, 6] = (-0.1, 0.0, 0.1), 1.0
    ids, frames = np.arange(400), np.arange(3)
    final = MapUpdate(
        frame=2, stamp_ns=2 * 10**8, frame_id="", state=TRACKING, reason="", segment=0,
        inliers=400, pose_frames=frames, pose_segments=np.zeros(3, np.int32), pose_keyframes=frames,
        poses_keyframe_camera=np.tile(np.eye(7)[6], (3, 1)),
        pose_inliers=np.full(3, 400, np.int32), keyframe_ids=frames, keyframe_frames=frames,
        keyframe_segments=np.zeros(3, np.int32), keyframe_poses=poses, point_ids=ids,
        point_segments=np.zeros(400, np.int32), points_world=points,
        point_colours=np.zeros((400, 3), np.uint8), point_keyframes=np.full(400, 3, np.int32),
        point_parallax_rad=np.ones(400, np.float32), point_sigmas=np.ones(400, np.float32),
        removed_point_ids=np.zeros(0, np.int64), calibration_correction=CORRECTION,
        point_hosts=np.zeros(400, np.int64),
    )  # fmt: skip
    tracks, images, keyframes = list[Extrema](), list[SourceImage](), list[Keyframe]()
    v, u = np.mgrid[:120, :160]
    pixels = cv2.imencode(".png", np.stack([u, v, 0 * u], axis=2).astype(np.uint8))[1].tobytes()
    for frame in range(3):
        local = points - poses[frame, :3]
        seen_px = seen_through_a_wrong_calibration(local[:, :2] / local[:, 2:])
        here = dataclasses.replace(
            FrameTracks.empty(), ids=ids, points_px=seen_px.astype(np.float32),
            ages=np.zeros(400, np.int32), kappas=np.ones(400, np.float32),
            states=np.zeros(400, np.uint8),
        )  # fmt: skip
        tracks.append(Extrema.of(dataclasses.replace(stream, frame=frame), here))
        seen_by = {"point_ids": ids, "points_px": seen_px.astype(np.float32)}
        told_of_it = Keyframe(
            frame=frame, **header, new=frame, keyframe_ids=frames[frame : frame + 1],
            settled=np.ones(1, np.bool_), counts=np.array([400], np.int32), **seen_by,
        )  # fmt: skip
        keyframes.append(told_of_it)
        image = {"encoding": "png", "width": 160, "height": 120, "data": pixels}
        images.append(SourceImage(frame=frame, stamp_ns=frame * 10**8, frame_id="", **image))
    folder = tmp_path_factory.mktemp("corrected")
    told = {
        topics.STREAM: [stream], topics.SOURCE: images, topics.EXTREMA: tracks,
        topics.KEYFRAME: keyframes, topics.MAP_FINAL: [final],
    }  # fmt: skip
    recorder.run(ReplayBus(told), Config(), folder / "recording.mcap", {})
    return folder


def test_a_colmap_model_has_the_camera_that_the_map_was_made_with(corrected_run: Path) -> None:
    pycolmap: Any = import_module("pycolmap")
    model = export_result(corrected_run, "colmap", None)
    read = pycolmap.Reconstruction(str(model / "sparse" / "0"))
    assert read.cameras[1].params[:2] == pytest.approx(100.0 * np.exp(0.05))
    assert read.num_points3D() > 350  # the others lie outside of the image
    read.update_point_3d_errors()
    assert read.compute_mean_reprojection_error() < 1e-2


def test_exported_images_are_those_of_the_corrected_camera(corrected_run: Path) -> None:
    folder = export_result(corrected_run, "images", None)
    lens = open_source(str(folder)).calibration.lens
    assert lens.fx == lens.fy == pytest.approx(100.0 * np.exp(0.05))
    pixels = cv2.imread(str(folder / "images" / "000001.png"))  # says where a pixel was taken from
    assert 110 < pixels.shape[0] < 120  # of the image what the lens has shown
    assert np.ptp(pixels[:, 0, 0]) > 0
    v, u = (x.ravel() for x in np.mgrid[15:95, 20:130])
    pinhole = np.stack([u - lens.cx, v - lens.cy], axis=1) / lens.fx
    taken_from = pixels[v, u, :2].astype(float)
    np.testing.assert_allclose(taken_from, seen_through_a_wrong_calibration(pinhole), atol=1.0)


def test_viewers_get_the_corrected_camera_at_the_end(corrected_run: Path) -> None:
    pytest.importorskip("foxglove_schemas_protobuf")
    decoder: Any = pytest.importorskip("mcap_protobuf.decoder")
    with export_result(corrected_run, "foxglove", None).open("rb") as file:
        reader = make_reader(file, decoder_factories=[decoder.DecoderFactory()])
        told = reader.iter_decoded_messages(topics=["/camera/calibration"])
        cameras = [message for *_, message in told]
    assert cameras[0].K[0] == 100.0
    assert cameras[-1].K[0] == cameras[-1].P[0] == pytest.approx(100.0 * np.exp(0.05))
    assert list(cameras[-1].D) == [*CORRECTION[1:3], 0.0, 0.0, 0.0]


@pytest.mark.parametrize("kind", ["colmap", "nerfstudio", "depth", "images"])
def test_images_that_were_not_recorded_are_one_line(
    kind: str, corrected_run: Path, tmp_path: Path
) -> None:
    told = {t: list(Recording(corrected_run / "recording.mcap").decoded(t)) for t in topics.TOPICS}
    told.pop(topics.SOURCE)
    recorder.run(ReplayBus(told), Config(), tmp_path / "recording.mcap", {})
    done = in_this_process("export", tmp_path, "--to", kind)
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert "has no images (--no-images)" in done.stderr
    assert not (tmp_path / kind).exists()
