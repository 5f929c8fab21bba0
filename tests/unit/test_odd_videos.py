"""Videos that OpenCV alone reads wrongly: other streams, edit lists, fields, sizes, names."""

import os
import subprocess
import sys
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from odd_videos import (
    HEIGHT,
    WIDTH,
    matroska,
    moving,
    packets_of,
    scene,
    with_aspect,
    with_cover,
    with_edits,
    with_track_before,
    write_video,
)

from pliant.algorithms.image.fields import is_combed
from pliant.config import IngestParameters
from pliant.datasets import notes_on, open_source
from pliant.datasets.base import BrokenFrame, SourceFrame
from pliant.datasets.mp4_boxes import video_streams
from pliant.datasets.packet_decoder import decodes, parameter_sets
from pliant.datasets.rectifier import Rectifier, decode
from pliant.datasets.source_spec import SourceSpec
from pliant.datasets.video import shown_frames
from pliant.datasets.video_decoder import opened, streams_of
from pliant.datasets.video_streams import Patch, PatchedFile, VideoStream, choose
from pliant.errors import DatasetError

FRAMES = 10


@pytest.fixture(scope="module")
def images() -> list[np.ndarray]:
    return moving(FRAMES)


@pytest.fixture
def film(tmp_path: Path, images: list[np.ndarray]) -> bytes:
    return write_video(tmp_path / "film.mp4", images)


@pytest.fixture
def preview(tmp_path: Path) -> bytes:
    return write_video(tmp_path / "preview.mp4", [scene(160, 120, seed=1)] * FRAMES)


def read(file: Path) -> list[SourceFrame]:
    return list(open_source(SourceSpec(location=str(file), fov_deg=60.0)))


def assert_film(frames: list[SourceFrame], images: list[np.ndarray]) -> None:
    """Those images, in their order."""
    assert [frame.index for frame in frames] == list(range(len(images)))
    for frame, image in zip(frames, images, strict=True):
        assert np.abs(decode(frame)[:, :, ::-1].astype(int) - image).mean() < 6.0


@pytest.mark.parametrize("enabled", [True, False])
def test_a_preview_before_the_film_is_passed_over(
    tmp_path: Path, film: bytes, preview: bytes, images: list[np.ndarray], enabled: bool
) -> None:
    """The film is the larger one; where one is enabled and the other is not, it is that."""
    file = tmp_path / "two.mp4"
    file.write_bytes(with_track_before(film, preview, enabled=enabled))
    dataset = open_source(SourceSpec(location=str(file), fov_deg=60.0))
    assert notes_on(dataset) == ["2 video streams (160x120, 320x240): reading stream 2"]
    assert (dataset.calibration.width, dataset.calibration.height) == (WIDTH, HEIGHT)
    assert_film(list(dataset), images)


def test_the_default_stream_wins_over_a_larger_one(
    tmp_path: Path, film: bytes, preview: bytes
) -> None:
    file = tmp_path / "two.mp4"
    file.write_bytes(with_track_before(preview, film, enabled=False))
    dataset = open_source(SourceSpec(location=str(file), fov_deg=60.0))
    assert (dataset.calibration.width, dataset.calibration.height) == (160, 120)
    assert len(list(dataset)) == FRAMES


def test_a_cover_picture_before_the_film_is_passed_over(
    tmp_path: Path, film: bytes, images: list[np.ndarray]
) -> None:
    file, jpeg = tmp_path / "cover.mp4", cv2.imencode(".jpg", scene(160, 160, seed=2))[1].tobytes()
    file.write_bytes(with_cover(film, jpeg))
    dataset = open_source(SourceSpec(location=str(file), fov_deg=60.0))
    assert (dataset.calibration.width, dataset.frame_count) == (WIDTH, FRAMES)
    assert_film(list(dataset), images)


def test_a_preview_in_matroska_is_passed_over(tmp_path: Path) -> None:
    tracks = []
    for size, default in ((160, True), (320, True), (640, False)):
        shown = moving(FRAMES, size, size)
        write_video(tmp_path / "part.webm", shown, "VP80")
        tracks.append(("V_VP8", size, size, default, packets_of(tmp_path / "part.webm")))
    file = tmp_path / "three.mkv"
    file.write_bytes(matroska(tracks))
    dataset = open_source(SourceSpec(location=str(file), fov_deg=60.0))
    note = "3 video streams (160x160, 320x320, 640x640): reading stream 2"
    assert notes_on(dataset) == [note]
    assert_film(list(dataset), moving(FRAMES, 320, 320))


@pytest.mark.parametrize(
    ("edits", "shown"),
    [
        ([(0.08, 0.2)], range(2, 7)),  # a lossless trim
        ([(-1, 1.0), (0.08, 0.2)], range(2, 7)),  # that begins late
        ([(0.0, 0.08), (0.24, 0.12)], [0, 1, 6, 7, 8]),  # a piece is cut out
        ([(0.0, 10.0)], range(10)),  # nothing is left out
        ([(20.0, 10.0)], range(10)),  # nothing would be shown
    ],
)
def test_an_edit_list_selects_the_frames(
    tmp_path: Path,
    film: bytes,
    images: list[np.ndarray],
    edits: list[tuple[float, float]],
    shown: list[int],
) -> None:
    file = tmp_path / "trim.mp4"
    file.write_bytes(with_edits(film, edits))
    dataset = open_source(SourceSpec(location=str(file), fov_deg=60.0))
    frames = list(dataset)
    assert dataset.frame_count == len(frames) == len(shown)
    assert_film(frames, [images[i] for i in shown])
    first = shown[0]
    assert [frame.stamp_ns for frame in frames] == [(i - first) * 40_000_000 for i in shown]


def test_interlaced_video_is_read_by_one_field(tmp_path: Path) -> None:
    """Of fields that were taken at two times no frame is a comb of both."""
    if not decodes("dvsd"):
        pytest.skip("OpenCV brings other libraries along")
    shown = moving(FRAMES, 720, 576, step=12)
    combed = [image.copy() for image in shown]
    for comb, later in zip(combed, shown[1:], strict=False):
        comb[1::2] = later[1::2]
    write_video(tmp_path / "tape.avi", combed[:-1], "dvsd")
    dataset = open_source(
        SourceSpec(location=str(tmp_path / "tape.avi"), fov_deg=60.0),
        IngestParameters(longest_side_px=720),
    )
    assert notes_on(dataset)[0].startswith("interlaced: one field of each frame")
    assert_film(list(dataset), shown[:-1])


@pytest.mark.parametrize("live", [False, True])
def test_frames_of_matroska_are_counted(tmp_path: Path, live: bool) -> None:
    """A screen recorder writes one where something moves, and a live one no lengths."""
    write_video(tmp_path / "part.webm", moving(6), "VP80")
    made, times = packets_of(tmp_path / "part.webm"), (0, 20, 40, 1000, 1020, 9000)
    packets = [(ms, data) for ms, (_, data) in zip(times, made, strict=True)]
    content = matroska([("V_VP8", WIDTH, HEIGHT, True, packets)])
    if live:
        for kind in (b"\x18\x53\x80\x67", b"\x1f\x43\xb6\x75"):
            parts = content.split(kind)
            content = kind.join(
                [parts[0], *(b"\x01" + b"\xff" * 7 + each[8:] for each in parts[1:])]
            )
    file = tmp_path / "screen.webm"
    file.write_bytes(content)
    dataset = open_source(SourceSpec(location=str(file), fov_deg=60.0))
    assert dataset.frame_count == 6
    assert [frame.stamp_ns for frame in dataset] == [ms * 1_000_000 for ms in times]


def test_a_cut_may_begin_with_frames_that_hang_on_what_is_gone() -> None:
    """They are not expected, and a decoder of H.264 is told what stands in the header alone."""
    times = [0, 40_000_000, 80_000_000, 120_000_000]
    stream = VideoStream(width=1, height=1, stamps_ns=times, origin_ns=80_000_000)
    assert shown_frames(stream, 4, 0) == 2
    assert shown_frames(stream, 4, -80_000_000) == 4

    class Cut:
        def get(self, property_id: int) -> float:
            return int.from_bytes(b"h264", "little") if property_id == cv2.CAP_PROP_FOURCC else 1

        def retrieve(self, image: None, index: int) -> tuple[bool, np.ndarray]:
            sets = b"\1\2\3\4\xff\xe1\0\3abc\1\0\2de"
            return True, np.frombuffer(sets, np.uint8).reshape(1, -1)

    found = parameter_sets(Cut())  # type: ignore[arg-type]
    assert found.tobytes() == b"\0\0\0\1abc\0\0\0\1de"


def test_two_fields_in_a_file_that_is_not_marked_interlaced(tmp_path: Path) -> None:
    """As of old tapes that were converted: a frame that is a comb of two times is one field."""
    shown = moving(FRAMES, 320, 240, step=6)
    combed = [image.copy() for image in shown]
    for comb, later in zip(combed, shown[1:], strict=False):
        comb[1::2] = later[1::2]
    write_video(tmp_path / "tape.avi", combed[:-1], "FFV1")
    dataset = open_source(SourceSpec(location=str(tmp_path / "tape.avi"), fov_deg=60.0))
    assert notes_on(dataset)[0].startswith("interlaced: one field of each frame")
    for frame, image in zip(dataset, shown, strict=False):
        assert np.abs(decode(frame)[:, :, ::-1].astype(int) - image).mean() < 1.0
    assert not any(is_combed(image) for image in (*shown, scene(320, 240, seed=3)))
    noise = np.random.default_rng(0).integers(0, 256, (240, 320, 3), np.uint8)
    assert not is_combed(noise)
    assert not is_combed(np.zeros((1, 1, 3), np.uint8))


def test_pixels_by_packets_are_those_of_opencv(tmp_path: Path) -> None:
    if not decodes("VP80"):
        pytest.skip("OpenCV brings other libraries along")
    file = tmp_path / "clip.webm"
    write_video(file, moving(FRAMES), "VP80")
    capture = cv2.VideoCapture(str(file), cv2.CAP_FFMPEG, [cv2.CAP_PROP_N_THREADS, 1])
    for frame in read(file):
        _, pixels = capture.read()
        assert np.asarray(pixels).tobytes() == frame.data
        assert round(1e6 * capture.get(cv2.CAP_PROP_POS_MSEC)) == frame.stamp_ns
    with opened(file) as decoder:
        for number in (7, 2, 5):
            assert decoder.seek_frame(number)
            assert decoder.grab()
            assert decoder.stamp_ns == number * 40_000_000


def test_a_size_that_changes_on_the_way(tmp_path: Path) -> None:
    """A frame of the same aspect is made as large as the first; one of another is broken."""
    if not decodes("VP80"):
        pytest.skip("OpenCV brings other libraries along")
    packets = []
    for part, size in enumerate(((320, 240), (640, 480), (240, 320))):
        write_video(tmp_path / "part.webm", moving(4, *size), "VP80")
        packets += packets_of(tmp_path / "part.webm", 160 * part)
    file = tmp_path / "call.webm"
    file.write_bytes(matroska([("V_VP8", 320, 240, True, packets)]))
    dataset = open_source(SourceSpec(location=str(file), fov_deg=60.0))
    rectifier, frames = Rectifier(dataset.calibration), list(dataset)
    assert len(frames) == 12
    for frame in frames[:8]:
        rectifier.rectify(frame)
    for frame in frames[8:]:
        with pytest.raises(BrokenFrame, match=r"240x320 px, but the camera has 320x240"):
            rectifier.rectify(frame)


def test_pixels_that_are_not_square(tmp_path: Path, film: bytes) -> None:
    file = tmp_path / "wide.mp4"
    file.write_bytes(with_aspect(film, 4, 3))
    dataset = open_source(str(file))
    assert notes_on(dataset) == ["pixel aspect ratio 1.33"]
    assert dataset.calibration.fy == pytest.approx(dataset.calibration.fx * 4 / 3)
    file.write_bytes(with_aspect(film, 1, 2))  # it is higher than wide now
    tall = open_source(str(file)).calibration
    assert tall.fy == pytest.approx(0.5 * HEIGHT / np.tan(np.radians(30.0)))
    assert tall.fx == pytest.approx(2.0 * tall.fy)
    file.write_bytes(with_aspect(film, 1, 1000))
    assert open_source(str(file)).calibration.fx == open_source(str(file)).calibration.fy
    file.with_suffix(".yaml").write_text(
        f"width: {WIDTH}\nheight: {HEIGHT}\nfx: 300\nfy: 301\ncx: 160\ncy: 120\n"
    )
    file.write_bytes(with_aspect(film, 4, 3))
    given = open_source(str(file))
    assert (given.calibration.fx, given.calibration.fy, notes_on(given)) == (300, 301, [])


@pytest.mark.parametrize(
    "name",
    [
        "2024-01-02T12:30:05.mp4",
        "http:b.mp4",
        "-film.mp4",
        "a%03d.mp4",
        os.fsdecode(b"caf\xe9.mp4"),
        os.fsdecode(b"caf\xe9/film.mp4"),
        "a\nb.mp4",
    ],
)
def test_any_name_is_that_of_a_file(
    tmp_path: Path, film: bytes, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_bytes(film)
    monkeypatch.chdir(tmp_path)
    for source in (name, str(tmp_path / name)):
        assert len(read(Path(source))) == FRAMES


@pytest.mark.parametrize(("width", "height"), [(4000, 4), (4, 4000)])
def test_a_film_too_narrow_to_track_in(tmp_path: Path, width: int, height: int) -> None:
    write_video(tmp_path / "strip.avi", [scene(width, height)] * 3, "FFV1")
    with pytest.raises(DatasetError, match=rf"images of {width}x{height} px are too narrow"):
        open_source(str(tmp_path / "strip.avi"))


def test_nothing_that_is_damaged_is_more_than_a_file_that_is_not_understood(
    tmp_path: Path, film: bytes
) -> None:
    """Wherever a header is cut or overwritten, reading it ends, without an error."""
    trimmed = with_edits(film, [(0.08, 0.2)])
    start = trimmed.index(b"moov")
    rng = np.random.default_rng(0)
    write_video(tmp_path / "part.webm", moving(2), "VP80")
    mkv = matroska([("V_VP8", WIDTH, HEIGHT, True, packets_of(tmp_path / "part.webm"))])
    file = tmp_path / "damaged.mp4"
    for _ in range(300):
        for content, first, last in ((trimmed, start, len(trimmed)), (mkv, 0, 300)):
            damaged = bytearray(content)
            at = int(rng.integers(first, last))
            damaged[at : at + 4] = rng.integers(0, 256, 4, np.uint8).tobytes()
            file.write_bytes(damaged[: int(rng.integers(at, len(damaged) + 1))])
            choose(streams_of(file))


def test_tables_of_an_index_are_no_larger_than_the_file(tmp_path: Path, film: bytes) -> None:
    """A number of samples takes no memory that the file has not."""
    at = film.index(b"stts")
    file = tmp_path / "large.mp4"
    huge = film[: at + 12] + (2**31 - 1).to_bytes(4) + film[at + 16 :]
    at = huge.index(b"stsz")
    file.write_bytes(huge[: at + 12] + (2**31 - 1).to_bytes(4) + huge[at + 16 :])
    with file.open("rb") as source:
        (stream,) = video_streams(source, file.stat().st_size).streams
    assert len(stream.stamps_ns) == 0


def test_a_file_of_which_some_bytes_read_otherwise(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_bytes(bytes(range(20)))
    expected = bytes([*range(3), *b"abc", *range(6, 19), ord("d")])
    patches = [Patch(3, b"abc"), Patch(19, b"d")]
    for size in range(1, 21):
        with PatchedFile(file, patches) as patched:
            assert b"".join(iter(partial(patched.read, size), b"")) == expected
            patched.seek(4)
            assert patched.read(size) == expected[4 : 4 + size]


def test_without_a_word_of_opencv_or_ffmpeg(tmp_path: Path, film: bytes) -> None:
    file = tmp_path / "tape.avi"
    write_video(file, moving(3, 720, 576), "dvsd")
    script = f"from pliant.datasets import open_source; list(open_source({str(file)!r}))"
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert done.stderr == ""
