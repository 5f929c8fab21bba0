"""``--mask``: a run on what is left of the images, its replay, and its exports."""

import base64
import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import cast

import cv2
import numpy as np
import pytest
from running import COARSE_MESH, TINY, assert_one_line, in_this_process

import pliant as pliant_api
from pliant.algorithms.image.masks import clearance_of, unpacked
from pliant.datasets import open_source
from pliant.datasets.builtin import builtin_folder
from pliant.datasets.source_spec import SourceSpec
from pliant.export.export import export_result
from pliant.export.models import draw
from pliant.messages import topics
from pliant.messages.codec import encode
from pliant.messages.types import Extrema, Keyframe, SourceImage
from pliant.recording.reader import Recording
from pliant.recording.writer import RecordingWriter
from pliant.viewers.canvas import Canvas, Moment

pytestmark = pytest.mark.system
HIDDEN = 160
"""First row of the image, 320x240, that a bonnet hides."""


@pytest.fixture(scope="module")
def bonnet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sequence whose lower third is a pattern, and its mask at half the size."""
    folder = tmp_path_factory.mktemp("bonnet")
    shutil.copytree(builtin_folder(TINY), folder / "drive")
    pattern = np.random.default_rng(1).integers(0, 256, (240 - HIDDEN, 320), np.uint8)
    for path in sorted((folder / "drive" / "images").iterdir()):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        image[HIDDEN:] = cv2.GaussianBlur(pattern, (0, 0), 1.5)
        cv2.imwrite(str(path), image)
    mask = np.full((120, 160), 255, np.uint8)
    mask[HIDDEN // 2 :] = 0
    cv2.imwrite(str(folder / "mask.png"), mask)
    return folder


@pytest.fixture(scope="module")
def result(bonnet: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run") / "drive"
    done = in_this_process(
        "run", bonnet / "drive", "--mask", bonnet / "mask.png", *COARSE_MESH, "--output", folder
    )
    assert done.returncode == 0, done.stderr
    assert "33 % of each image are ignored (mask.png)" in done.stderr
    return folder


def test_nothing_of_a_run_lies_under_its_mask(result: Path) -> None:
    recording = Recording(result / "recording.mcap")
    for source, tracks in zip(
        recording.decoded(topics.SOURCE), recording.decoded(topics.EXTREMA), strict=True
    ):
        assert isinstance(source, SourceImage)
        assert isinstance(tracks, Extrema)
        assert unpacked(source.mask).shape == (120, 160)
        assert len(source.mask) < 200
        assert len(tracks.ids) > 500
        assert tracks.points_px[:, 1].max() < HIDDEN - 4
    shown = [m for m in recording.decoded(topics.KEYFRAME) if isinstance(m, Keyframe)]
    for message in shown:
        assert message.images().keys() == message.masks().keys()
        for mask in message.masks().values():
            assert not unpacked(mask)[HIDDEN:].any()
    assert sum(len(message.masks()) for message in shown) > 3
    assert json.loads((result / "report.json").read_text())["verdict"] == "good"


class Shown:
    """A canvas that keeps the images alone."""

    def __init__(self, dims_masks: bool) -> None:
        self.dims_masks = dims_masks
        self.images: list[np.ndarray] = []

    def image(self, at: Moment, data: bytes, encoding: str) -> None:
        self.images.append(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE))

    def __getattr__(self, name: str) -> Callable[..., None]:
        return lambda *_: None


def assert_dark_below(image: np.ndarray, whole: np.ndarray, scale: float = 1.0) -> None:
    """Where the mask has it ignored, and nowhere else."""
    row = round(scale * HIDDEN)
    for part, low, high in ((slice(row + 4, None), 0.2, 0.4), (slice(row - 4), 0.75, 1.3)):
        share = float(image[part].mean()) / float(whole[: image.shape[0]][part].mean())
        assert low < share < high


def test_what_is_left_out_is_dark_to_the_eye(result: Path, bonnet: Path, tmp_path: Path) -> None:
    paths = sorted((bonnet / "drive" / "images").iterdir())
    files = [np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)) for path in paths]
    seen, raw = Shown(True), Shown(False)
    for canvas in (seen, raw):
        draw(Recording(result / "recording.mcap"), cast(Canvas, canvas))
    assert len(seen.images) == len(raw.images) == len(files)
    for shown, as_it_is, file in zip(seen.images, raw.images, files, strict=True):
        assert_dark_below(shown, file)
        np.testing.assert_array_equal(as_it_is, file)
    video = cv2.VideoCapture(str(export_result(result, "overlay", tmp_path / "overlay.webm")))
    good, frame = video.read()
    assert good
    assert_dark_below(cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)[:240], files[0])
    page = (result / "report.html").read_text(encoding="utf-8")
    (clip,) = re.findall(r"<img [^>]*data:image/webp;base64,([^\"]+)", page)
    data = np.frombuffer(base64.b64decode(clip), np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)
    assert_dark_below(np.asarray(image), files[0], image.shape[0] / 240)


def test_its_replay_gives_the_same_bytes(result: Path, tmp_path: Path) -> None:
    done = in_this_process("replay", result, "--check", "--output", tmp_path / "again")
    assert done.returncode == 0, done.stdout + done.stderr


def test_its_recording_is_a_source_with_the_mask(result: Path, bonnet: Path) -> None:
    first = next(iter(open_source(str(result))))
    assert unpacked(first.mask).shape == (120, 160)
    anew = bonnet / "other.png"
    cv2.imwrite(str(anew), np.eye(240, 320, dtype=np.uint8))
    masked = next(iter(open_source(SourceSpec(location=str(result), mask=anew))))
    assert unpacked(masked.mask).shape == (240, 320)


def test_an_image_is_found_in_its_map_by_what_is_left(result: Path, bonnet: Path) -> None:
    known = pliant_api.load_map(result)
    path = sorted((bonnet / "drive" / "images").iterdir())[20]
    image = np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), np.uint8)
    other = image.copy()
    other[HIDDEN:] = np.random.default_rng(2).integers(0, 256, other[HIDDEN:].shape, np.uint8)
    mask = np.ones(image.shape, np.uint8)
    mask[HIDDEN:] = 0
    first, second = (known.localise(each, mask=mask) for each in (image, other))
    assert first is not None
    assert second is not None
    assert first.inliers == second.inliers > 100
    np.testing.assert_allclose(first.T_world_camera, second.T_world_camera, atol=1e-6)


@pytest.mark.parametrize(
    ("kind", "masks"),
    [("nerfstudio", "{}"), ("colmap", "{}.png"), ("images", "{}"), ("depth", "{}")],
)
def test_exports_have_masks_beside_images(
    result: Path, tmp_path: Path, kind: str, masks: str
) -> None:
    folder = export_result(result, kind, tmp_path / "export")
    names = {path.name for path in (folder / "images").iterdir()}
    assert names
    assert {path.name for path in (folder / "masks").iterdir()} == {masks.format(n) for n in names}
    for name in sorted(names):
        mask = cv2.imread(str(folder / "masks" / masks.format(name)), cv2.IMREAD_UNCHANGED)
        image = cv2.imread(str(folder / "images" / name), cv2.IMREAD_GRAYSCALE)
        assert mask is not None
        assert image is not None
        assert mask.shape == image.shape
        assert set(np.unique(mask)) == {0, 255}
        bound = round(HIDDEN * mask.shape[0] / 240)
        assert (clearance_of(mask[: bound - 8] > 0) > 0).all()
        assert not mask[bound + 8 :].any()
        if kind == "depth":
            depth = cv2.imread(str(folder / "depth" / name), cv2.IMREAD_UNCHANGED)
            assert depth is not None
            assert not depth[mask == 0].any()


@pytest.fixture(scope="module")
def partly(result: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recording of a run with a mask for every third frame, as ``--mask FOLDER`` gives."""
    path = tmp_path_factory.mktemp("partly") / "recording.mcap"
    whole = Recording(result / "recording.mcap")
    with RecordingWriter(path, whole.metadata()) as part:
        for recorded in whole.messages():
            data, message = recorded.data, None
            if recorded.topic == topics.SOURCE:
                message = recorded.decode()
                assert isinstance(message, SourceImage)
                data = data if message.frame % 3 == 0 else encode(replace(message, mask=b""))
            part.write(recorded.topic, data, sequence=0, log_time_ns=0, publish_time_ns=0)
    return path


@pytest.mark.parametrize("masked", ["all", "some", "none"])
def test_nerfstudio_takes_what_it_gets(
    result: Path, partly: Path, tiny_run: Path, tmp_path: Path, masked: str
) -> None:
    """By the rules of nerfstudio's own parser of ``transforms.json``, and of who reads its masks:
    masks of all images or of none, of one channel; a camera model of its table; no key that it
    would turn or scale the cameras by and not the points."""
    run = {"all": result, "some": partly, "none": tiny_run}[masked]
    folder = export_result(run, "nerfstudio", tmp_path / "export")
    said = json.loads((folder / "transforms.json").read_text())
    assert said["camera_model"] in (
        *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"),
    )
    for key in ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2"):
        assert isinstance(said[key], float), key
    size = said["h"], said["w"]
    assert all(isinstance(side, int) for side in size)
    assert not {"applied_transform", "applied_scale", "orientation_override"} & said.keys()
    assert (folder / said["ply_file_path"]).is_file()
    frames = said["frames"]
    assert len({frame["file_path"] for frame in frames}) == len(frames) > 3
    assert sum("mask_path" in frame for frame in frames) == (0 if masked == "none" else len(frames))
    black = 0
    for frame in frames:
        matrix = np.array(frame["transform_matrix"])
        assert matrix.shape == (4, 4)
        assert np.isfinite(matrix).all()
        assert cv2.imread(str(folder / frame["file_path"])).shape[:2] == size
        if masked != "none":
            mask = cv2.imread(str(folder / frame["mask_path"]), cv2.IMREAD_UNCHANGED)
            assert mask is not None
            assert mask.shape == size
            black += bool((mask == 0).any())
    assert {"all": black == len(frames), "some": 0 < black < len(frames), "none": not black}[masked]


def test_a_mask_that_is_none_is_one_line(bonnet: Path, tmp_path: Path) -> None:
    for mask, words in (("nothing.png", "cannot be read"), ("drive", "contains no images")):
        done = in_this_process(
            "run", bonnet / "drive", "--mask", bonnet / mask, "--output", tmp_path / "result"
        )
        assert_one_line(done, words)
        assert not (tmp_path / "result").exists()
