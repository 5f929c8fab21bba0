"""A recording of a video holds the video: its images are those that the run had, or none."""

import errno
import os
import random
import re
import tempfile
import threading
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from mp4_patches import spaced, ticks_a_second, turned

import pliant
from pliant.algorithms.image.masks import unpacked
from pliant.bus.replay_bus import ReplayBus
from pliant.bus.session import free_endpoint, open_router
from pliant.bus.zenoh_bus import ZenohBus
from pliant.config import Config, IngestParameters, load_config
from pliant.datasets import open_source
from pliant.datasets.base import Dataset
from pliant.datasets.clip import clip_of
from pliant.datasets.recorded_images import RecordedImages
from pliant.datasets.video import quiet_opencv
from pliant.errors import RecordingError, SourceLostError
from pliant.messages import codec, topics
from pliant.messages.topics import Topic
from pliant.messages.types import ClipPiece, Header, SourceImage
from pliant.recording.layout import CHUNK_BYTES
from pliant.recording.parts import parts_of
from pliant.recording.reader import Recording
from pliant.recording.recover import recover
from pliant.recording.summary import describe, summarise
from pliant_services.nodes import ingest, recorder
from pliant_services.replay.play import PlayRequest, run_play
from pliant_services.runtime.monitor import SilentMonitor

FRAMES, WIDTH, HEIGHT = 30, 160, 120
FPS = 10.0
PATIENCE_S = 60.0


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Texture that moves; frames hang on earlier ones (MPEG-4), a key frame is every twelfth."""
    file = tmp_path_factory.mktemp("clip") / "clip.mp4"
    texture = cv2.GaussianBlur(
        np.random.default_rng(0).integers(0, 256, (240, 320, 3), np.uint8), (9, 9), 2.0
    )
    with quiet_opencv():
        writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"mp4v"), FPS, (WIDTH, HEIGHT))
    if not writer.isOpened():
        pytest.skip("OpenCV cannot write a video here")
    for number in range(FRAMES):
        writer.write(np.ascontiguousarray(texture[number:, 2 * number :][:HEIGHT, :WIDTH]))
    writer.release()
    return file


def record(
    dataset: Dataset, path: Path, settings: Sequence[str] = (), bus: ReplayBus | None = None
) -> list[SourceImage]:
    """Record a source; what the run had is returned."""
    config = load_config(overrides=settings)
    bus = bus or ReplayBus({})
    try:
        ingest.run(bus, config, SilentMonitor(), dataset, stopping=lambda: False)
    finally:
        logged = {t: m for t, m in bus.outputs.items() if t.logged}
        packages = {"packages": {"opencv-python-headless": "4.5"}}
        recorder.run(ReplayBus(logged), config, path, packages)
    return published_on(bus)


def published_on(bus: ReplayBus) -> list[SourceImage]:
    return [m for m in bus.outputs[topics.SOURCE] if isinstance(m, SourceImage)]


def opened(clip: Path, **part: float) -> Dataset:
    return open_source(str(clip), fov_deg=60.0, part=IngestParameters(**part))  # type: ignore[arg-type]


def references(path: Path) -> list[SourceImage]:
    found = Recording(path).decoded(topics.SOURCE)
    return [m for m in found if isinstance(m, SourceImage)]


def assert_same_images(path: Path, published: list[SourceImage]) -> None:
    made = list(RecordedImages(Recording(path)))
    assert [m.frame for m in made] == [m.frame for m in published]
    for again, was in zip(made, published, strict=True):
        assert again == replace(was, clip_frame=-1)


def test_the_recording_of_a_video_is_as_large_as_the_video(clip: Path, tmp_path: Path) -> None:
    path = tmp_path / "recording.mcap"
    published = record(opened(clip), path)
    assert path.stat().st_size < clip.stat().st_size + 300 * FRAMES + 16_000
    assert path.stat().st_size < 0.1 * sum(len(m.data) for m in published)
    pieces = [m for m in Recording(path).decoded(topics.CLIP) if isinstance(m, ClipPiece)]
    assert b"".join(piece.data for piece in pieces) == clip.read_bytes()
    assert all(not m.data and m.clip_frame == m.frame for m in references(path))
    assert_same_images(path, published)
    assert "images: frames of clip.mp4, which is in it as it was" in "\n".join(
        describe(summarise(path))
    )


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
    side = int(part.pop("longest_side_px", 0))
    chosen = IngestParameters(**part)  # type: ignore[arg-type]
    dataset = open_source(str(clip), fov_deg=60.0, longest_side_px=side, part=chosen)
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
    part = IngestParameters(start_s=0.95, every=5)
    dataset = open_source(str(clip), fov_deg=60.0, longest_side_px=96, part=part, mask=masks)
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

    def publish(self, topic: Topic, message: Header, *, may_lag: Collection[str] = ()) -> None:
        super().publish(topic, message, may_lag=may_lag)
        if topic == topics.IMAGE and message.frame == self._frame:
            with self._clip.open("ab") as file:
                file.write(b"more")


def test_a_clip_that_is_written_to_during_the_run_costs_no_image_and_is_told(
    clip: Path, tmp_path: Path
) -> None:
    own = tmp_path / "own.mp4"
    own.write_bytes(clip.read_bytes())
    path = tmp_path / "recording.mcap"
    bus = WritingBus(own, 9)
    with pytest.raises(SourceLostError, match=r"own.mp4: was written to while it was read"):
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


def rewritten(path: Path, made: Path, change: dict[Topic, object]) -> Path:
    """A recording with other messages on some topics."""
    logged: dict[Topic, list[Header]] = {}
    for message in Recording(path).messages():
        if message.topic != topics.STREAM_END:
            logged.setdefault(message.topic, []).append(message.decode())
    logged |= change  # type: ignore[arg-type]
    metadata = {"packages": {"opencv-python-headless": "4.5"}}
    recorder.run(ReplayBus({t: m for t, m in logged.items() if m}), Config(), made, metadata)
    return made


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
        with pytest.raises(RecordingError, match=f"frame {number}: OpenCV .* makes other") as said:
            RecordedImages(Recording(made)).whole(stored[number])
        assert "with OpenCV 4.5" in str(said.value)
        assert "\n" not in str(said.value)
    without = rewritten(path, tmp_path / "without.mcap", {topics.CLIP: []})
    with pytest.raises(RecordingError, match="the clip is not in it"):
        list(RecordedImages(Recording(without)))
    no_video = [replace(pieces[0], size=4, offset=0, data=b"none")]
    made = rewritten(path, tmp_path / "none.mcap", {topics.CLIP: no_video})
    with pytest.raises(RecordingError, match="cannot read the clip in it"):
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


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of several pieces: the last ones hold the index of the container."""
    file = tmp_path_factory.mktemp("large") / "large.avi"
    noise = np.random.default_rng(1)
    with quiet_opencv():
        writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"MJPG"), FPS, (640, 480))
    if not writer.isOpened():
        pytest.skip("OpenCV cannot write a video here")
    for _ in range(18):
        writer.write(noise.integers(0, 256, (480, 640, 3), np.uint8))
    writer.release()
    assert file.stat().st_size > 3 * CHUNK_BYTES
    return file


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


def test_a_recording_in_parts_is_read_as_one(large: Path, tmp_path: Path) -> None:
    path = tmp_path / "recording.mcap"
    published = record(opened(large), path, ["recorder.roll_mib=1"])
    assert len(parts_of(path)) > 2
    assert_same_images(path, published)
    with pytest.raises(RecordingError, match=r"bytes are missing|one part of several"):
        list(RecordedImages(Recording(parts_of(path)[-1])))


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


def test_it_is_a_source_with_the_frames_of_the_run(clip: Path, tmp_path: Path) -> None:
    path = tmp_path / "recording.mcap"
    published = record(opened(clip, every=2), path)
    assert [(f.stamp_ns, f.data) for f in open_source(str(path))] == [
        (m.stamp_ns, m.data) for m in published
    ]


@pytest.fixture
def endpoint() -> Iterator[str]:
    found = free_endpoint()
    router = open_router(found)
    yield found
    router.close()


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


def test_a_clip_that_finds_no_room_is_said(
    clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "recording.mcap"
    record(opened(clip), path)

    def full(**_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(tempfile, "NamedTemporaryFile", full)
    with pytest.raises(RecordingError, match="No space left on device; make room there"):
        list(RecordedImages(Recording(path)))
