"""RGB pictures to image, video and animation files."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pliant.algorithms.arrays import U8
from pliant.errors import ResultError
from pliant.formats.text import write_bytes

# Formats that the headless wheels of OpenCV encode without codecs of the system.  Browsers play
# VP8, and neither MPEG-4 Part 2 nor MJPEG; VP9 takes five times as long for two thirds of the size.
_VIDEO_CODECS = {".webm": ("VP80", ".mkv"), ".mp4": ("mp4v", ".mp4"), ".avi": ("MJPG", ".avi")}
_MATROSKA = b"\x42\x82\x88matroska"
_WEBM = b"\x42\x82\x84webm\xec\x82\0\0"
"""The type of a document, as EBML has it; the second with an element of nothing behind it."""
_WEBP_QUALITY = 85
GROUND = 18
"""Grey value between pictures."""

_ANIMATIONS = (".webp", ".gif", ".avif")


def write_image(path: Path, picture: U8) -> None:
    """Write (H, W, 3) RGB in the format of the suffix.  ResultError if that is unknown."""
    try:
        options = [cv2.IMWRITE_WEBP_QUALITY, _WEBP_QUALITY] if path.suffix == ".webp" else []
        good, data = cv2.imencode(path.suffix, np.ascontiguousarray(picture[:, :, ::-1]), options)
    except cv2.error:
        good, data = False, np.zeros(0, np.uint8)
    if not good:
        raise ResultError(f"{path}: unknown kind of image; use .png or .jpg")
    write_bytes(path, data.tobytes())


def write_movie(path: Path, pictures: Iterable[U8], *, fps: float) -> int:
    """Write (H, W, 3) RGB pictures as a video; returns how many.

    Raises ResultError for a suffix other than .webm, .mp4 and .avi, pictures that change size, no
    pictures at all, and a file that cannot be written.
    """
    suffix = path.suffix.lower()
    if suffix not in _VIDEO_CODECS:
        raise ResultError(f"{path}: unknown kind of video; use {', '.join(_VIDEO_CODECS)}")
    codec, container = _VIDEO_CODECS[suffix]
    partial = path.with_name(f"{path.name}.partial{container}")
    write_bytes(partial, b"")  # a clear error where the folder is not there
    try:
        count = _encode(partial, path, pictures, codec, fps)
        if suffix == ".webm":
            _call_webm(partial)
        partial.replace(path)
    except OSError as error:
        raise ResultError(f"{path}: cannot be written ({error.strerror})") from None
    finally:
        partial.unlink(missing_ok=True)
    return count


def _encode(partial: Path, path: Path, pictures: Iterable[U8], codec: str, fps: float) -> int:
    """path: what the file is to become.   Raises ResultError."""
    writer: Any = None
    size = (0, 0)
    count = 0
    try:
        for picture in pictures:
            if writer is None:
                size = (picture.shape[1], picture.shape[0])
                writer = _writer(partial, path, codec, fps, size)
            if (picture.shape[1], picture.shape[0]) != size:
                raise ResultError(f"{path}: picture {count} has another size than the first")
            writer.write(np.ascontiguousarray(picture[:, :, ::-1]))
            count += 1
    finally:
        if writer is not None:
            writer.release()
    if not count:
        raise ResultError(f"{path}: there are no frames to write")
    if partial.stat().st_size == 0:
        raise ResultError(f"{path}: cannot be written (is the disk full?)")
    return count


def _writer(partial: Path, path: Path, codec: str, fps: float, size: tuple[int, int]) -> Any:
    try:
        name = f"file:{partial}"  # a name with a colon is none of a protocol
        name.encode()
    except UnicodeEncodeError:
        raise ResultError(
            f"{path}: OpenCV writes no video where a name is not UTF-8: give another --output"
        ) from None
    code = cv2.VideoWriter.fourcc(*codec)
    writer = cv2.VideoWriter(name, cv2.CAP_FFMPEG, code, fps, size)
    if not writer.isOpened():
        raise ResultError(
            f"{path}: this OpenCV cannot encode {codec}: name a file that ends in "
            f"{' or '.join(each for each in _VIDEO_CODECS if each != path.suffix)}"
        )
    return writer


def _call_webm(matroska: Path) -> None:
    """Make WebM of VP8 in Matroska: of that it is a part, and has its name in its header.

    OpenCV writes WebM, too, with two lines on the terminal that cannot be silenced.
    """
    with matroska.open("r+b") as file:
        at = file.read(64).index(_MATROSKA)
        file.seek(at)
        file.write(_WEBM)


def animation_suffix(path: Path) -> str:
    """The suffix of an animation; raises ResultError for any other."""
    suffix = path.suffix.lower()
    if suffix not in _ANIMATIONS:
        raise ResultError(f"{path}: unknown kind of animation; use {', '.join(_ANIMATIONS)}")
    return suffix


def write_animation(path: Path, pictures: Sequence[U8], *, fps: float, quality: int = 55) -> None:
    """Write a looping animation that a README can show.

    pictures: (H, W, 3) RGB of one size.      quality: of .webp and .avif, 1 to 100.
    Raises ResultError for a suffix other than .webp, .gif and .avif, no pictures, an OpenCV older
    than 4.11, and a file that cannot be written.
    """
    suffix = animation_suffix(path)
    if not pictures:
        raise ResultError(f"{path}: there are no frames to write")
    data = encode_animation(pictures, fps=fps, suffix=suffix, quality=quality)
    write_bytes(path, data)


def encode_animation(
    pictures: Sequence[U8], *, fps: float, suffix: str, quality: int = 55
) -> bytes:
    """The bytes of an animation; see ``write_animation``.  Raises ResultError."""
    module: Any = cv2
    if not hasattr(module, "imencodeanimation"):
        raise ResultError("animations need OpenCV 4.11: pip install 'opencv-python-headless>=4.11'")
    animation = module.Animation()
    animation.frames = [np.ascontiguousarray(picture[:, :, ::-1]) for picture in pictures]
    animation.durations = np.full(len(pictures), round(1000.0 / fps), np.int32)
    animation.loop_count = 0
    options = {
        ".webp": [cv2.IMWRITE_WEBP_QUALITY, quality],
        ".avif": [cv2.IMWRITE_AVIF_QUALITY, quality],
        ".gif": [],
    }
    good, data = module.imencodeanimation(suffix, animation, options[suffix])
    if not good:
        raise ResultError(f"this OpenCV cannot encode {suffix}")
    return data.tobytes()


def beside(*pictures: U8, gap: int = 4) -> U8:
    """RGB pictures of one height next to each other."""
    between = np.full((len(pictures[0]), gap, 3), GROUND, np.uint8)
    parts = [part for picture in pictures for part in (between, picture)]
    return np.concatenate(parts[1:], axis=1)
