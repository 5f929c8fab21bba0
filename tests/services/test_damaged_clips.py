"""A recording of a video gives the images that the run had, or a line: damage, lies, no room."""

import errno
import os
import re
import tempfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from recorded_clips import (
    FPS,
    FRAMES,
    HEIGHT,
    WIDTH,
    assert_same_images,
    opened,
    record,
    references,
    rewritten,
)

from pliant.datasets.clip import clip_of
from pliant.datasets.recorded_images import RecordedImages
from pliant.datasets.video_decoder import quiet_opencv
from pliant.errors import RecordingError
from pliant.messages import topics
from pliant.recording.layout import CHUNK_BYTES
from pliant.recording.reader import Recording
from pliant.recording.recover import recover


def test_a_damaged_clip_is_recorded_and_decoded_as_the_run_did(clip: Path, tmp_path: Path) -> None:
    content = bytearray(clip.read_bytes())
    for place in range(3000, len(content) - 4000, 1500):
        content[place : place + 12] = bytes(12)
    own = tmp_path / "damaged.mp4"
    own.write_bytes(content)
    path = tmp_path / "recording.mcap"
    published = record(opened(own), path)
    assert not any(m.data for m in references(path))
    assert_same_images(path, published)


def test_what_decodes_to_other_pixels_is_refused_in_one_line(clip: Path, tmp_path: Path) -> None:
    path = tmp_path / "recording.mcap"
    record(opened(clip), path)
    other = tmp_path / "other.mp4"
    with quiet_opencv():
        writer = cv2.VideoWriter(str(other), cv2.VideoWriter.fourcc(*"mp4v"), FPS, (WIDTH, HEIGHT))
    for _ in range(FRAMES):
        writer.write(np.full((HEIGHT, WIDTH, 3), 99, np.uint8))
    writer.release()
    pieces = list(clip_of(opened(other)).pieces())  # type: ignore[union-attr]
    made = rewritten(path, tmp_path / "made.mcap", {topics.CLIP: pieces})
    stored = references(path)
    for number in (0, 20):
        with pytest.raises(
            RecordingError, match=f"frame {number}: OpenCV .* decodes other"
        ) as said:
            RecordedImages(Recording(made)).whole(stored[number])
        assert "with OpenCV 4.5" in str(said.value)
        assert "\n" not in str(said.value)
    without = rewritten(path, tmp_path / "without.mcap", {topics.CLIP: []})
    with pytest.raises(RecordingError, match="the clip of its images is missing"):
        list(RecordedImages(Recording(without)))
    no_video = [replace(pieces[0], size=4, offset=0, data=b"none")]
    made = rewritten(path, tmp_path / "none.mcap", {topics.CLIP: no_video})
    with pytest.raises(RecordingError, match="cannot read its clip"):
        list(RecordedImages(Recording(made)))
    beyond = [replace(pieces[0], offset=pieces[0].size)]
    made = rewritten(path, tmp_path / "beyond.mcap", {topics.CLIP: beyond})
    with pytest.raises(RecordingError, match="beyond its end"):
        list(RecordedImages(Recording(made)))


@pytest.mark.parametrize("how", ["checksum", "number", "size", "huge"])
def test_a_reference_that_lies_gives_no_image(clip: Path, tmp_path: Path, how: str) -> None:
    path = tmp_path / "recording.mcap"
    record(opened(clip), path)
    lies = {
        "checksum": {"checksum": 1},
        "number": {"clip_frame": 10**15},
        "size": {"width": WIDTH // 2},
        "huge": {"width": 10**9, "height": 10**9},
    }[how]
    image = replace(references(path)[5], **lies)  # type: ignore[arg-type]
    with pytest.raises(RecordingError, match="frame 5: OpenCV"):
        RecordedImages(Recording(path)).whole(image)


def test_damage_to_the_clip_in_a_recording_costs_no_more_than_its_images(
    large: Path, tmp_path: Path
) -> None:
    """Of each image there are the right pixels, or a line; also after `pliant recover`."""
    path, clean = tmp_path / "recording.mcap", tmp_path / "clean.mcap"
    published = record(opened(large), path)
    content = bytearray(path.read_bytes())
    content[2 * CHUNK_BYTES : 2 * CHUNK_BYTES + 100] = bytes(100)
    path.write_bytes(content)
    recover(path, clean)
    for file in (path, clean):
        images, refused = RecordedImages(Recording(file)), 0
        for stored, was in zip(references(clean), published, strict=True):
            try:
                made = images.whole(stored).data
            except RecordingError as error:
                refused += bool(re.search(r"\d+ of its \d+ bytes are missing", str(error)))
                continue
            assert made == was.data
        assert 0 < refused < len(published)


def test_a_recording_that_was_cut_off_has_the_images_of_its_messages(
    large: Path, tmp_path: Path
) -> None:
    path = tmp_path / "recording.mcap"
    published = record(opened(large), path)
    with path.open("r+b") as file:
        file.truncate(path.stat().st_size - 1000)
    recover(path, tmp_path / "clean.mcap")
    kept = references(tmp_path / "clean.mcap")
    assert kept
    assert_same_images(tmp_path / "clean.mcap", published[: len(kept)])


def test_a_clip_that_finds_no_room_is_said(
    clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "recording.mcap"
    record(opened(clip), path)

    def full(**_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(tempfile, "NamedTemporaryFile", full)
    with pytest.raises(RecordingError, match="No space left on device; free some space there"):
        list(RecordedImages(Recording(path)))
