"""A recording of a video holds the video: its images are those that the run had, or none."""

import os
import random
import threading
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mp4_patches import spaced, ticks_a_second, turned
from odd_videos import moving, with_edits, with_track_before, write_video
from recorded_clips import (
    FRAMES,
    HEIGHT,
    WIDTH,
    assert_same_images,
    opened,
    published_on,
    record,
    references,
)

import pliant
from pliant.algorithms.image.masks import unpacked
from pliant.bus.replay_bus import ReplayBus
from pliant.bus.zenoh_bus import ZenohBus
from pliant.config import Config, IngestParameters
from pliant.datasets import open_source
from pliant.datasets.clip import clip_of
from pliant.datasets.recorded_images import RecordedImages
from pliant.datasets.source_spec import SourceSpec
from pliant.errors import RecordingError, SourceLostError
from pliant.messages import codec, topics
from pliant.messages.topics import Topic
from pliant.messages.types import ClipPiece, Header, SourceImage
from pliant.recording.parts import parts_of
from pliant.recording.reader import Recording
from pliant.recording.summary import describe, summarise
from pliant_services.nodes import ingest
from pliant_services.replay.play import PlayRequest, run_play
from pliant_services.runtime.monitor import SilentMonitor

PATIENCE_S = 60.0


def test_a_video_whose_name_is_not_utf_8_is_recorded(clip: Path, tmp_path: Path) -> None:
    own, path = tmp_path / os.fsdecode(b"caf\xe9.mp4"), tmp_path / "recording.mcap"
    own.write_bytes(clip.read_bytes())
    assert_same_images(path, record(opened(own), path))
    assert "frames of caf?.mp4" in "\n".join(describe(summarise(path)))


def test_images_of_odd_videos_are_made_again(tmp_path: Path) -> None:
    """The stream that was read, what its edit list shows, and one field of interlaced frames."""
    film = write_video(tmp_path / "film.mp4", moving(12))
    preview = write_video(tmp_path / "preview.mp4", moving(12, 160, 120))
    odd = with_edits(with_track_before(film, preview), [(0.08, 0.24)])
    (tmp_path / "odd.mp4").write_bytes(odd)
    write_video(tmp_path / "tape.avi", moving(12, 720, 576), "dvsd")
    for name, frames in (("odd.mp4", 6), ("tape.avi", 12)):
        path = tmp_path / f"{name}.mcap"
        published = record(opened(tmp_path / name), path)
        assert len(published) == frames
        assert all(image.clip_frame >= 0 for image in published)
        assert_same_images(path, published)
        images, kept = RecordedImages(Recording(path)), references(path)
        for number in (frames - 1, 2, frames // 2):  # in any order
            assert images.whole(kept[number]).data == published[number].data


def test_the_recording_of_a_video_is_as_large_as_the_video(clip: Path, tmp_path: Path) -> None:
    path = tmp_path / "recording.mcap"
    published = record(opened(clip), path)
    assert path.stat().st_size < clip.stat().st_size + 300 * FRAMES + 16_000
    assert path.stat().st_size < 0.1 * sum(len(m.data) for m in published)
    pieces = [m for m in Recording(path).decoded(topics.CLIP) if isinstance(m, ClipPiece)]
    assert b"".join(piece.data for piece in pieces) == clip.read_bytes()
    assert all(not m.data and m.clip_frame == m.frame for m in references(path))
    assert_same_images(path, published)
    assert "images: frames of clip.mp4, stored unchanged" in "\n".join(describe(summarise(path)))


@pytest.mark.parametrize(
    "part",
    [
        {"start_s": 0.75},
        {"end_s": 1.0, "every": 3},
        {"every": 4, "sharpest": True},
        {"longest_side_px": 96, "start_s": 0.5, "every": 2},
    ],
)
def test_a_part_of_a_video_and_a_smaller_size(
    clip: Path, tmp_path: Path, part: dict[str, float]
) -> None:
    side = part.get("longest_side_px")
    chosen = IngestParameters(**part)  # type: ignore[arg-type]
    dataset = open_source(SourceSpec(location=str(clip), fov_deg=60.0), chosen)
    published = record(dataset, tmp_path / "recording.mcap")
    assert {(m.width, m.height) for m in published} == {(96, 72) if side else (WIDTH, HEIGHT)}
    assert not any(m.data for m in references(tmp_path / "recording.mcap"))
    assert_same_images(tmp_path / "recording.mcap", published)


def test_a_masked_video_is_recorded_as_the_video_and_its_masks(clip: Path, tmp_path: Path) -> None:
    masks = tmp_path / "masks"
    masks.mkdir()
    for number in range(0, FRAMES, 2):
        mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
        mask[:, : number + 1] = 0
        cv2.imwrite(str(masks / f"{number}.png"), mask)
    part = IngestParameters(start_s=0.95, every=5, longest_side_px=96)
    dataset = open_source(SourceSpec(location=str(clip), fov_deg=60.0, mask=masks), part)
    path = tmp_path / "recording.mcap"
    published = record(dataset, path)
    assert not any(m.data for m in references(path))
    assert_same_images(path, published)
    black = [int((~unpacked(m.mask)[0]).sum()) if m.mask else 0 for m in published]
    assert black == [11, 0, 21, 0]
    assert [frame.mask for frame in open_source(str(path))] == [m.mask for m in published]


@pytest.mark.parametrize("degrees", [90, 180, 270])
def test_a_clip_of_a_telephone_held_upright(clip: Path, tmp_path: Path, degrees: int) -> None:
    """What is in the recording is turned as the run had it, in order and by itself."""
    own, content = tmp_path / "own.mp4", clip.read_bytes()
    tick = ticks_a_second(content) // 20
    own.write_bytes(spaced(turned(content, degrees), [tick, 3 * tick] * (FRAMES // 2)))
    path = tmp_path / "recording.mcap"
    published = record(opened(own), path)
    lying = degrees == 180
    size = (WIDTH, HEIGHT) if lying else (HEIGHT, WIDTH)
    assert {(m.width, m.height) for m in published} == {size}
    assert [round(1e-6 * m.stamp_ns) for m in published[:4]] == [0, 50, 200, 250]
    assert not any(m.data for m in references(path))
    assert_same_images(path, published)
    images = RecordedImages(Recording(path))
    for number in (20, 3):
        assert images.whole(references(path)[number]).data == published[number].data


def test_any_image_by_itself(clip: Path, tmp_path: Path) -> None:
    """Backwards, far ahead, twice: what the container says of its frames decides nothing."""
    path = tmp_path / "recording.mcap"
    published = record(opened(clip), path)
    images, stored = RecordedImages(Recording(path)), references(path)
    order = [*range(FRAMES)] * 2
    random.Random(0).shuffle(order)
    for number in (0, FRAMES - 1, FRAMES - 1, 0, *order):
        assert images.whole(stored[number]).data == published[number].data
    result = pliant.open(path)
    assert result.image(FRAMES - 1).shape == (HEIGHT, WIDTH, 3)


def test_the_smaller_of_clip_and_frames_is_kept(large: Path, tmp_path: Path) -> None:
    one_frame = {"end_s": 0.05}
    assert large.stat().st_size > 2 * 3 * 640 * 480
    assert clip_of(opened(large)) is not None
    assert clip_of(opened(large, start_s=0.1)) is not None
    assert clip_of(opened(large, every=9)) is None
    assert clip_of(opened(large, **one_frame)) is None
    assert clip_of(open_source("built-in:tiny?frames=2")) is None
    published = record(opened(large, **one_frame), tmp_path / "recording.mcap")
    assert published == references(tmp_path / "recording.mcap")


@pytest.mark.parametrize("setting", ["recorder.clip=false", "bus.link_images=jpeg"])
def test_frames_are_recorded_where_they_are_wanted_or_others(
    clip: Path, tmp_path: Path, setting: str
) -> None:
    published = record(opened(clip), tmp_path / "recording.mcap", [setting])
    assert references(tmp_path / "recording.mcap") == published
    assert all(m.data for m in published)


class WritingBus(ReplayBus):
    """Writes to the clip when a frame of it has been published."""

    def __init__(self, clip: Path, frame: int) -> None:
        super().__init__({})
        self._clip, self._frame = clip, frame

    def publish(self, topic: Topic, message: Header, **how: Any) -> None:
        super().publish(topic, message, **how)
        if topic == topics.IMAGE and message.frame == self._frame:
            with self._clip.open("ab") as file:
                file.write(b"more")


def test_a_clip_that_is_written_to_during_the_run_is_reported_and_costs_no_image(
    clip: Path, tmp_path: Path
) -> None:
    own = tmp_path / "own.mp4"
    own.write_bytes(clip.read_bytes())
    path = tmp_path / "recording.mcap"
    bus = WritingBus(own, 9)
    with pytest.raises(SourceLostError, match=r"own.mp4: was modified during the run"):
        record(opened(own), path, bus=bus)
    published = published_on(bus)
    stored = references(path)
    assert [m.frame for m in stored if m.data] == list(range(10, FRAMES))
    assert_same_images(path, published)


class ResumedBus(ReplayBus):
    """One whose service was killed after a checkpoint."""

    def __init__(self, state: object) -> None:
        super().__init__({})
        self._state = state

    def restore(self) -> object:
        return self._state


class KeepingBus(ReplayBus):
    state: object = None

    def checkpoint(self, frame: int, state: object) -> None:
        if frame == 11:
            self.state = state


@pytest.mark.parametrize("changed", [False, True])
def test_a_run_that_is_taken_up_with_another_file_keeps_its_images(
    clip: Path, tmp_path: Path, changed: bool
) -> None:
    before, dataset = KeepingBus({}), opened(clip)
    ingest.run(before, Config(), SilentMonitor(), dataset, stopping=lambda: False)
    if changed:
        own = tmp_path / "clip.mp4"
        own.write_bytes(clip.read_bytes() + b"more")
        dataset = opened(own)
    after = ResumedBus(before.state)
    ingest.run(after, Config(), SilentMonitor(), dataset, stopping=lambda: False)
    sources = [m for m in after.outputs[topics.SOURCE] if isinstance(m, SourceImage)]
    expected = [-1 if changed else number for number in range(12, FRAMES)]
    assert [m.clip_frame for m in sources] == expected
    assert all(m.data for m in sources)


def test_a_recording_in_parts_is_read_as_one(large: Path, tmp_path: Path) -> None:
    path = tmp_path / "recording.mcap"
    published = record(opened(large), path, ["recorder.roll_mib=1"])
    assert len(parts_of(path)) > 2
    assert_same_images(path, published)
    with pytest.raises(RecordingError, match=r"bytes are missing|one part of several"):
        list(RecordedImages(Recording(parts_of(path)[-1])))


def test_it_is_a_source_with_the_frames_of_the_run(clip: Path, tmp_path: Path) -> None:
    path = tmp_path / "recording.mcap"
    published = record(opened(clip, every=2), path)
    assert [(f.stamp_ns, f.data) for f in open_source(str(path))] == [
        (m.stamp_ns, m.data) for m in published
    ]


def test_a_replay_plays_pixels(endpoint: str, clip: Path, tmp_path: Path) -> None:
    path = tmp_path / "recording.mcap"
    bus = ReplayBus({})
    published = record(opened(clip), path, bus=bus)
    request = PlayRequest(
        recording=path, rate=0.0, start_s=1.0, readers=["tracking"], connect=[endpoint]
    )
    player = threading.Thread(target=run_play, args=[request])
    player.start()
    with ZenohBus(
        endpoints=[endpoint],
        session="replay",
        service="tracking",
        inputs={topics.STREAM: "ingest", topics.IMAGE: "ingest"},
        outputs={},
        window=4,
    ) as reader:
        list(reader.receive(topics.STREAM))
        images = [codec.encode(m) for m in reader.receive(topics.IMAGE)]
    player.join(PATIENCE_S)
    first = next(m.frame for m in published if m.stamp_ns >= published[0].stamp_ns + 10**9)
    assert images == [codec.encode(m) for m in bus.outputs[topics.IMAGE][first:]]
