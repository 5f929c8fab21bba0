"""The size that images are worked on at: that of their details, whatever their pixels."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from benchmarks.in_process import process

from pliant.algorithms.arrays import U8
from pliant.algorithms.image.sharpness import resized, sharpness, working_side
from pliant.algorithms.map_delta import TRACKING
from pliant.config import IngestParameters, load_config
from pliant.datasets import Dataset, SourceFrame, decode, open_source
from pliant.datasets.calibration import Calibration
from pliant.datasets.rectifier import Rectifier, rectified
from pliant.datasets.source_spec import SourceSpec
from pliant.datasets.working_size import SmallerImages, at_working_size
from pliant.evaluation.run_evaluation import evaluate_trajectory
from pliant.formats.trajectory_files import read_trajectory
from pliant.map_history import MapHistory


def picture(width: int, height: int, noise: float = 1.0, seed: int = 1) -> U8:
    """As a camera sees: 1/f of every frequency on every other tile, a good lens, some noise."""
    rng = np.random.default_rng(seed)
    rows, columns = np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width)[None]
    frequency = np.maximum(np.hypot(rows, columns), 1.0 / width)
    spectrum = np.fft.rfft2(rng.normal(0.0, 1.0, (height, width))) / frequency
    image = np.fft.irfft2(spectrum, (height, width))
    tile = height // 3
    image *= (np.arange(height)[:, None] // tile + np.arange(width)[None] // tile) % 2
    image = cv2.GaussianBlur(image * (30.0 / image.std()), (0, 0), 0.5)
    image += rng.normal(0.0, noise, image.shape)
    return np.clip(image + 128.0, 0.0, 255.0).astype(np.uint8)


def enlarged(image: U8, width: int) -> U8:
    height = round(image.shape[0] * width / image.shape[1])
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_CUBIC), np.uint8)


class Pictures:
    """A source of pictures, some of them broken."""

    name, is_live, ground_truth_path = "pictures", False, None

    def __init__(self, images: list[U8], broken: tuple[int, ...] = ()) -> None:
        height, width = images[0].shape[:2]
        self.frame_count: int | None = len(images)
        self.calibration = Calibration(
            model="pinhole-radtan", width=width, height=height, fx=0.8 * width, fy=0.8 * width,
            cx=0.5 * width - 3.0, cy=0.5 * height + 2.0, distortion=(-0.1, 0.01, 0.0, 0.0, 0.0),
        )  # fmt: skip
        self._images, self._broken = images, broken
        self._stamps_ns = list(range(len(images)))

    def __iter__(self) -> Iterator[SourceFrame]:
        for i, image in enumerate(self._images):
            data = cv2.imencode(".png", image)[1].tobytes()
            data = data[:-20] if i in self._broken else data
            yield SourceFrame(index=i, stamp_ns=self._stamps_ns[i], encoding="png", data=data)


class Enlarged(Pictures):
    """A source at another width, enlarged."""

    def __init__(self, source: Dataset, width: int) -> None:
        small = source.calibration
        frames = list(source)
        images = [enlarged(decode(frame)[..., ::-1], width) for frame in frames]
        super().__init__(images)
        self._stamps_ns = [frame.stamp_ns for frame in frames]
        across, down = width / small.width, images[0].shape[0] / small.height
        self.calibration = replace(
            small, width=width, height=images[0].shape[0], fx=small.fx * across,
            fy=small.fy * down, cx=(small.cx + 0.5) * across - 0.5,
            cy=(small.cy + 0.5) * down - 0.5, depth=None,
        )  # fmt: skip


@pytest.mark.parametrize("noise", [0.0, 1.0, 3.0])
@pytest.mark.parametrize("gain", [1.0, 0.4])
def test_sharpness_depends_on_details_not_on_contrast_and_noise(noise: float, gain: float) -> None:
    sharp = picture(960, 540, noise)
    soft = enlarged(picture(480, 270, noise), 960)
    for image, expected in ((sharp, 960), (soft, 679)):
        dimmed = (image * gain).astype(np.uint8)
        assert working_side([dimmed]) == expected


def test_the_size_is_that_of_the_sharpest_and_within_limits() -> None:
    sharp = picture(1280, 360)
    soft = enlarged(picture(320, 90), 1280)
    assert working_side([sharp]) == 1280
    assert working_side([soft]) == 640
    assert working_side([soft, sharp, soft]) == 1280
    assert working_side([enlarged(sharp, 2560)]) == 1280
    assert working_side([soft.T.copy()]) == 640  # the longer side, also of a portrait
    for width, height in ((320, 96), (640, 480)):  # softness is no reason to lose more
        assert working_side([enlarged(picture(width // 4, height // 4), width)]) == width
    black = np.zeros((540, 960), np.uint8)
    assert working_side([black]) == 960  # says nothing
    assert working_side([black, enlarged(picture(320, 180), 960)]) == 679
    assert sharpness(black) == 0.0


def test_what_is_sharp_or_small_comes_as_it_is() -> None:
    for image in (picture(960, 200), picture(320, 96)):
        source = Pictures([image] * 3)
        assert at_working_size(source) is source


def test_smaller_images_are_what_their_camera_sees() -> None:
    dot = np.zeros((480, 1920), np.uint8)
    u, v = 1412, 333
    cv2.circle(dot, (u, v), 9, 255, -1)
    source = Pictures([dot])
    smaller = SmallerImages(source, 640)
    assert (smaller.calibration.width, smaller.calibration.height) == (640, 160)
    frame = next(iter(smaller))
    grey = decode(frame).astype(np.float64)
    assert frame.made_from == "png of 1920x480 px"
    rows, columns = np.mgrid[: grey.shape[0], : grey.shape[1]]
    found = (columns * grey).sum() / grey.sum(), (rows * grey).sum() / grey.sum()
    lenses = source.calibration.lens, smaller.calibration.lens
    planes = [
        (np.array(at) - (lens.cx, lens.cy)) / (lens.fx, lens.fy)
        for at, lens in zip(((u, v), found), lenses, strict=True)
    ]
    np.testing.assert_allclose(planes[0], planes[1], atol=2e-4)


def test_a_resized_source_states_its_size_and_broken_frames_stay_broken() -> None:
    images = [enlarged(picture(480, 160, seed=i), 1920) for i in range(8)]
    sources = [at_working_size(Pictures(images, broken=(0, 6))) for _ in range(2)]
    assert [source.calibration.width for source in sources] == [640, 640]
    assert sources[0].calibration == sources[1].calibration
    first, second = (list(source) for source in sources)
    assert first == second
    rectifier = Rectifier(sources[0].calibration)
    missing = [rectified(frame, rectifier).missing for frame in first]
    assert [i for i, why in enumerate(missing) if why] == [0, 6]
    assert "cut off" in missing[0]
    wanted = at_working_size(Pictures(images), 1000)
    assert wanted.calibration.width == 1000
    whole = Pictures(images)
    assert at_working_size(whole, 1920) is whole


def test_a_source_is_opened_at_its_working_size(tmp_path: Path) -> None:
    image = enlarged(picture(320, 180), 1280)
    for i in range(2):
        cv2.imwrite(str(tmp_path / f"{i}.png"), image)
    opened = open_source(SourceSpec(location=str(tmp_path), fov_deg=60.0))
    assert (opened.calibration.width, opened.calibration.height) == (640, 360)
    assert opened.frame_count == 2
    np.testing.assert_array_equal(decode(next(iter(opened))), resized(image, 640))
    whole = open_source(
        SourceSpec(location=str(tmp_path), fov_deg=60.0), IngestParameters(longest_side_px=1280)
    )
    assert whole.calibration.width == 1280


@pytest.mark.slow
def test_a_run_goes_well_at_every_size() -> None:
    tiny = open_source("built-in:tiny")
    assert tiny.ground_truth_path is not None
    truth = read_trajectory(tiny.ground_truth_path)
    ates: list[float] = []
    for source in (tiny, at_working_size(Enlarged(tiny, 1600))):
        history = MapHistory()
        frames = [frame.delta for frame in process(source, load_config(), history)]
        assert sum(delta.state == TRACKING for delta in frames) > 0.7 * len(frames)
        ate = evaluate_trajectory(
            history.trajectory(history.final()), truth, frames=len(frames)
        ).ate_m
        assert ate is not None
        ates.append(ate.rmse)
    assert max(ates) < 0.005
