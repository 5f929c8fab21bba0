"""Borders and overlays that never change are found and masked; scenes that stand still are not."""

from collections.abc import Callable, Iterator
from dataclasses import replace

import cv2
import numpy as np

from pliant.algorithms.arrays import U8
from pliant.algorithms.image.masks import packed, unpacked
from pliant.algorithms.image.static_regions import StaticMask, StaticRegions
from pliant.datasets.base import SourceFrame
from pliant.datasets.calibration import calibration_from_fov
from pliant.datasets.static_mask import StaticallyMasked, static_counters, static_line

WIDTH, HEIGHT, FPS = 320, 240, 10
Frames = Callable[[int], U8]


def scene(seed: int = 0) -> U8:
    """A large texture with detail at several scales."""
    generator, image = np.random.default_rng(seed), np.zeros((900, 1200), np.float32)
    for cells in (15, 45, 135):
        noise = generator.uniform(0, 255, (cells * 3 // 4, cells)).astype(np.float32)
        image += cv2.resize(noise, (1200, 900), interpolation=cv2.INTER_CUBIC) / 3.0
    return np.clip(image, 0, 255).astype(np.uint8)


SCENE = scene()


def moving(number: int) -> U8:
    """The scene as a camera sees it that moves on a curve, with noise."""
    x, y = 300 + int(250 * np.cos(0.21 * number)), 300 + int(200 * np.sin(0.13 * number))
    noise = np.random.default_rng(number).normal(0.0, 2.0, (HEIGHT, WIDTH))
    return np.clip(SCENE[y : y + HEIGHT, x : x + WIDTH] + noise, 0, 255).astype(np.uint8)


def in_circle(number: int) -> U8:
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    cv2.circle(mask, (WIDTH // 2, HEIGHT // 2), 130, 255, -1)
    return np.where(mask > 0, moving(number), np.uint8(12))


def letterboxed(number: int) -> U8:
    image = moving(number)
    image[:30], image[-30:] = 16, 16
    return image


def with_text(number: int) -> U8:
    image = moving(number)
    cv2.putText(image, "CAM 1", (20, 220), cv2.FONT_HERSHEY_SIMPLEX, 0.8, 255, 2)
    return image


def still_with_somebody(number: int) -> U8:
    """A camera that stands still; something moves through a third of its image."""
    noise = np.random.default_rng(number).normal(0.0, 2.0, (HEIGHT, WIDTH))
    image = np.clip(SCENE[:HEIGHT, :WIDTH] + noise, 0, 255).astype(np.uint8)
    left = (7 * number) % 200
    image[:, left : left + 100] = moving(number)[:, :100]
    return image


def under_dark_sky(number: int) -> U8:
    """Roofs under a sky as dark as any border, from a camera that moves."""
    image = moving(number)
    x = np.arange(WIDTH) + 300 + int(250 * np.cos(0.21 * number))
    roof = 80 + 25 * np.sign(np.sin(0.09 * x)) + 20 * np.sin(0.21 * number)
    image[np.arange(HEIGHT)[:, None] < roof] = 8
    return image


def decided(frames: Frames, count: int = 80) -> list[StaticMask | None]:
    regions, found = StaticRegions(), list[StaticMask | None]()
    for number in range(count):
        stamp_ns = number * 10**9 // FPS
        if regions.is_wanted(stamp_ns) and regions.add(frames(number), stamp_ns):
            found.append(regions.decide((WIDTH, HEIGHT)))
    return found


def test_circle_is_found_with_its_edge() -> None:
    first, second = decided(in_circle)
    for found in (first, second):
        assert found is not None
        assert list(found.shares) == ["circle"]
        y, x = np.mgrid[:HEIGHT, :WIDTH]
        off = np.hypot(x - WIDTH // 2, y - HEIGHT // 2)
        assert not found.used[off > 129].any()
        assert found.used[off < 118].all()


def test_bars_are_found() -> None:
    found = decided(letterboxed)[0]
    assert found is not None
    assert list(found.shares) == ["bars"]
    assert not found.used[:31].any()
    assert not found.used[-31:].any()
    assert found.used[42:-42].all()


def test_text_is_found_at_the_second_decision() -> None:
    first, second = decided(with_text)
    assert first is None
    assert second is not None
    assert list(second.shares) == ["overlay"]
    drawn = with_text(0) != moving(0)
    assert not second.used[drawn].any()
    assert second.used.mean() > 0.85


def test_scene_is_no_border() -> None:
    for frames in (moving, still_with_somebody, under_dark_sky):
        assert not any(decided(frames)), frames.__name__


class _Film:
    """Frames as a source."""

    name, frame_count, ground_truth_path = "film", 80, None

    def __init__(self, frames: Frames, *, is_live: bool = False, mask: bytes = b"") -> None:
        self.calibration = calibration_from_fov(WIDTH, HEIGHT, 60.0)
        self.is_live = is_live
        self._frames, self._mask = frames, mask

    def __iter__(self) -> Iterator[SourceFrame]:
        for number in range(self.frame_count):
            pixels = self._frames(number)
            yield SourceFrame(
                index=number,
                stamp_ns=number * 10**9 // FPS,
                encoding="mono8",
                data=pixels.tobytes(),
                width=WIDTH,
                height=HEIGHT,
                mask=self._mask,
            )


def test_file_is_masked_from_its_first_frame() -> None:
    dataset = StaticallyMasked(_Film(in_circle))
    masks = [frame.mask for frame in dataset]
    assert all(masks)
    assert not unpacked(masks[0])[0, 0]
    line = static_line(static_counters(dataset))
    assert line.endswith("% of the image never changes and is masked: circle")


def test_camera_is_masked_from_the_decision_on() -> None:
    frames = list(StaticallyMasked(_Film(in_circle, is_live=True)))
    begin = next(frame.index for frame in frames if frame.mask)
    assert 16 <= begin < 60
    assert not any(frame.mask for frame in frames[:begin])
    assert all(frame.mask for frame in frames[begin:])
    again = StaticallyMasked(_Film(in_circle, is_live=True))
    assert [replace(frame, name="") for frame in again] == frames


def test_mask_that_a_frame_brings_along_stays() -> None:
    own = packed(np.eye(HEIGHT, WIDTH) == 0)
    assert {frame.mask for frame in StaticallyMasked(_Film(in_circle, mask=own))} == {own}


def test_nothing_is_said_where_nothing_was_found() -> None:
    dataset = StaticallyMasked(_Film(moving))
    assert not any(frame.mask for frame in dataset)
    assert static_line(static_counters(dataset)) == ""
