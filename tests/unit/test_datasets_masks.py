"""Masks of a source: whose they are, what they say, and what is no mask."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from raw_frames import DISTORTED, HEIGHT, PLAIN, WIDTH, picture, raw

from pliant.algorithms.arrays import U8, BoolArray
from pliant.algorithms.image.masks import packed, unpacked
from pliant.config import IngestParameters
from pliant.datasets import notes_on, open_source
from pliant.datasets import rectifier as datasets_rectifier
from pliant.datasets.base import SourceFrame
from pliant.datasets.rectifier import Rectifier, rectified
from pliant.datasets.source_spec import SourceSpec
from pliant.errors import DatasetError
from pliant.messages.types import BROKEN, MASKED

USED = np.ones((HEIGHT, WIDTH), np.bool_)
USED[30:] = False
BLACK = np.zeros((HEIGHT, WIDTH), np.uint8)


def write(path: Path, pixels: U8) -> Path:
    path.parent.mkdir(exist_ok=True)
    assert cv2.imwrite(str(path), pixels)
    return path


def images(folder: Path, names: Sequence[str] = ("a.jpg", "b.jpg", "c.jpg")) -> str:
    for name in names:
        write(folder / name, picture(colour=False))
    return str(folder)


def video(path: Path, frames: int = 6) -> str:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (WIDTH, HEIGHT))
    for _ in range(frames):
        writer.write(picture())
    writer.release()
    return str(path)


def columns(count: int) -> U8:
    """So many white columns: by them a mask is told from others."""
    mask = BLACK.copy()
    mask[:, :count] = 255
    return mask


def told(source: str, mask: Path, **part: object) -> list[int]:
    """White columns of each frame's mask; all of them where it has none."""
    parameters = IngestParameters.model_validate(part)
    frames = open_source(SourceSpec(location=source, fov_deg=60.0, mask=mask), parameters)
    return [int(unpacked(f.mask)[0].sum()) if f.mask else WIDTH for f in frames]


@pytest.mark.parametrize(
    ("name", "pixels"),
    [
        ("m.png", 255 * USED.astype(np.uint8)),
        ("m.png", USED.astype(np.uint8)),  # labels: 0 and 1
        ("m.png", 256 * USED.astype(np.uint16)),
        ("m.png", np.repeat(255 * USED.astype(np.uint8)[:, :, None], 3, axis=2)),
        ("m.jpg", 255 * USED.astype(np.uint8)),  # black is not exact there
    ],
)
def test_one_image_is_for_all_frames(tmp_path: Path, name: str, pixels: U8) -> None:
    opened = open_source(
        SourceSpec(
            location=images(tmp_path / "images"), fov_deg=60.0, mask=write(tmp_path / name, pixels)
        )
    )
    frames = list(opened)
    assert len({frame.mask for frame in frames}) == 1
    got = unpacked(frames[0].mask)
    assert (got != USED).mean() < (0.03 if name.endswith("jpg") else 1e-9)
    assert notes_on(opened)[-1:] == [f"masked: 38 % of each image are ignored ({name})"]
    assert all(len(frame.mask) < 300 for frame in frames)


def test_a_white_mask_is_none(tmp_path: Path) -> None:
    white = write(tmp_path / "white.png", np.full_like(BLACK, 255))
    opened = open_source(SourceSpec(location=images(tmp_path / "images"), fov_deg=60.0, mask=white))
    assert [frame.mask for frame in opened] == [b""] * 3


def test_a_folder_has_them_by_the_names_of_images(tmp_path: Path) -> None:
    source = images(tmp_path / "images")
    masks = tmp_path / "masks"
    write(masks / "b.png", columns(2))
    write(masks / "a.jpg.png", columns(1))  # as COLMAP has it
    write(masks / "other.png", columns(9))
    assert told(source, masks) == [1, 2, WIDTH]
    said = notes_on(open_source(SourceSpec(location=source, fov_deg=60.0, mask=masks)))
    assert said[-1:] == ["masked: 2 of 3 frames have a mask, the others are used completely"]


def test_a_folder_has_them_by_the_numbers_of_frames(tmp_path: Path) -> None:
    source = video(tmp_path / "clip.avi")
    some, all_of_them = tmp_path / "some", tmp_path / "all"
    for number in (0, 2, 4):
        write(some / f"frame_{number:05d}.png", columns(number + 1))
    for number in range(1, 7):  # as FFmpeg counts
        write(all_of_them / f"{number}.png", columns(number))
    assert told(source, some) == [1, WIDTH, 3, WIDTH, 5, WIDTH]
    assert told(source, all_of_them) == [1, 2, 3, 4, 5, 6]
    # The numbers are those of the source, whatever part of it is taken.
    assert told(source, some, every=2) == [1, 3, 5]
    assert told(source, some, start_s=0.15, every=2) == [3, 5]
    # Images whose names nobody has used.
    assert told(images(tmp_path / "images"), some) == [1, WIDTH, 3]


def test_a_mask_that_breaks_later_breaks_its_frame_alone(tmp_path: Path) -> None:
    source = images(tmp_path / "images")
    masks = tmp_path / "masks"
    write(masks / "a.png", columns(1))
    (masks / "b.png").write_bytes(b"no image")
    write(masks / "c.png", np.zeros((HEIGHT, 3 * WIDTH), np.uint8))
    opened = open_source(SourceSpec(location=source, fov_deg=60.0, mask=masks))
    rectifier = Rectifier(opened.calibration)
    made = [rectified(frame, rectifier).missing for frame in opened]
    assert made[0] == ""
    assert made[1:] == [
        f"{BROKEN}frame 1: its mask is no image that can be read",
        f"{BROKEN}frame 2: its mask is 192x48 px, another aspect than the image's 64x48 px",
    ]


def test_a_frame_without_a_mask_is_whole_after_masked_ones(tmp_path: Path) -> None:
    write(tmp_path / "masks" / "b.png", columns(20))
    opened = open_source(
        SourceSpec(location=images(tmp_path / "images"), fov_deg=60.0, mask=tmp_path / "masks")
    )
    rectifier = Rectifier(opened.calibration)
    made = [rectified(frame, rectifier) for frame in opened]
    assert [image.missing for image in made] == ["", "", ""]
    assert [image.mask != b"" for image in made] == [False, True, False]


@pytest.mark.parametrize(
    ("mask", "words"),
    [
        ("nowhere.png", "nowhere.png: cannot be read: No such file"),
        ("text.png", "text.png: OpenCV cannot read this image"),
        ("black.png", "black.png: is completely black"),
        ("wide.png", "is 192x48 px, another aspect than the image's 64x48 px"),
        ("empty", "empty: contains no images"),
        ("others", "has no mask for any frame: the first should be a.png, but is z.png"),
        ("twice", "1.png and m1.png are masks of the same frame"),
    ],
)
def test_what_is_no_mask_is_said_in_a_line(tmp_path: Path, mask: str, words: str) -> None:
    (tmp_path / "text.png").write_text("hello")
    (tmp_path / "empty").mkdir()
    write(tmp_path / "black.png", BLACK)
    write(tmp_path / "wide.png", np.zeros((HEIGHT, 3 * WIDTH), np.uint8))
    write(tmp_path / "others" / "z.png", columns(3))
    for name in ("1.png", "m1.png"):
        write(tmp_path / "twice" / name, columns(3))
    with pytest.raises(DatasetError) as raised:
        open_source(
            SourceSpec(location=images(tmp_path / "images"), fov_deg=60.0, mask=tmp_path / mask)
        )
    assert words in str(raised.value)
    assert str(raised.value).startswith("--mask ")
    assert "\n" not in str(raised.value)


def with_mask(used: BoolArray) -> SourceFrame:
    return replace(raw(picture(colour=False), "mono8"), mask=packed(used))


def test_a_mask_is_rectified_with_its_image() -> None:
    image = np.where(USED, np.uint8(255), np.uint8(0))
    for calibration in (PLAIN, DISTORTED):
        rectifier = Rectifier(calibration)
        shown, _ = rectifier.rectify(raw(image, "mono8"))
        mask = rectifier.mask(with_mask(USED))
        np.testing.assert_array_equal(unpacked(mask), shown == 255)
        twice = cv2.resize(USED.astype(np.uint8), None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST)
        assert rectifier.mask(with_mask(twice > 0)) == mask
        assert rectifier.mask(with_mask(np.ones_like(USED))) == b""
        made = rectified(with_mask(USED), rectifier)
        assert made.mask == mask
        covered = rectified(with_mask(np.zeros_like(USED)), rectifier)
        assert (covered.missing, covered.mask) == (MASKED, b"")


def test_a_mask_that_stays_is_unpacked_once(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[bytes] = []
    monkeypatch.setattr(datasets_rectifier, "unpacked", lambda m: asked.append(m) or unpacked(m))
    rectifier, frame = Rectifier(DISTORTED), with_mask(USED)
    made = [rectified(replace(frame, index=index), rectifier) for index in range(3)]
    assert len({image.mask for image in made}) == len(asked) == 1
