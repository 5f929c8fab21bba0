"""Videos as few programs write them, made of what OpenCV writes: by boxes of MP4 and EBML."""

import struct
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest

from pliant.datasets.video_decoder import quiet_opencv

WIDTH, HEIGHT = 320, 240


def scene(width: int = WIDTH, height: int = HEIGHT, seed: int = 0) -> np.ndarray:
    """Texture, (height, width, 3), that any codec keeps."""
    noise = np.random.default_rng(seed).integers(0, 256, (height, width, 3), np.uint8)
    return cv2.GaussianBlur(noise, (0, 0), 3.0)


def write_video(
    file: Path,
    images: Sequence[np.ndarray],
    code: str = "mp4v",
    *,
    rate: float = 25.0,
) -> bytes:
    """A video of images of one size by OpenCV; its bytes."""
    size = (images[0].shape[1], images[0].shape[0])
    with quiet_opencv():
        writer = cv2.VideoWriter(
            str(file), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*code), rate, size
        )
    if not writer.isOpened():
        pytest.skip(f"OpenCV cannot write {code} here")
    for image in images:
        writer.write(np.ascontiguousarray(image))
    writer.release()
    return file.read_bytes()


def moving(count: int, width: int = WIDTH, height: int = HEIGHT, step: int = 4) -> list[np.ndarray]:
    """Texture that moves to the left by so many pixels an image."""
    whole = scene(width + step * count, height)
    return [whole[:, step * i : step * i + width] for i in range(count)]


# MP4


def box(kind: bytes, *parts: bytes) -> bytes:
    """A box of MP4."""
    body = b"".join(parts)
    return struct.pack(">I4s", 8 + len(body), kind) + body


def boxes(data: bytes) -> Iterator[tuple[bytes, bytes, int]]:
    """Kind, body and place of each box."""
    at = 0
    while at + 8 <= len(data):
        size, kind = struct.unpack_from(">I4s", data, at)
        yield kind, data[at + 8 : at + size], at
        at += size


def changed(data: bytes, path: Sequence[bytes], change: Callable[[bytes], bytes]) -> bytes:
    """Boxes whose bodies at a path are changed; () changes what there is here."""
    if not path:
        return change(data)
    made = [
        box(kind, changed(body, path[1:], change) if kind == path[0] else body)
        for kind, body, _ in boxes(data)
    ]
    return b"".join(made)


def moov_of(mp4: bytes) -> tuple[bytes, bytes]:
    """What lies before the index, and its body: OpenCV writes it last, so nothing moves with it."""
    body, at = next((body, at) for kind, body, at in boxes(mp4) if kind == b"moov")
    return mp4[:at], body


def with_track_before(mp4: bytes, other: bytes, *, enabled: bool = True) -> bytes:
    """The file with the track of another before its own."""
    before, moov = moov_of(mp4)
    media, theirs = moov_of(other)
    start = next(at for kind, _, at in boxes(media) if kind == b"mdat")
    shift = len(before) - start

    def renamed(header: bytes) -> bytes:
        flags = header[3] & ~1 | enabled
        return header[:3] + bytes([flags]) + header[4:12] + struct.pack(">I", 9) + header[16:]

    def moved(table: bytes) -> bytes:
        places = struct.unpack_from(f">{int.from_bytes(table[4:8])}I", table, 8)
        return table[:8] + struct.pack(f">{len(places)}I", *(at + shift for at in places))

    track = next(body for kind, body, _ in boxes(theirs) if kind == b"trak")
    track = changed(track, [b"tkhd"], renamed)
    track = changed(track, [b"mdia", b"minf", b"stbl", b"stco"], moved)
    parts = [box(kind, body) for kind, body, _ in boxes(moov)]
    first = next(i for i, (kind, _, _) in enumerate(boxes(moov)) if kind == b"trak")
    parts.insert(first, box(b"trak", track))
    return before + media[start:] + box(b"moov", *parts)


def with_cover(mp4: bytes, jpeg: bytes) -> bytes:
    """The file with a cover picture, said before its track."""
    before, moov = moov_of(mp4)
    handler = box(b"hdlr", bytes(8), b"mdirappl", bytes(10))
    cover = box(b"covr", box(b"data", struct.pack(">2I", 13, 0), jpeg))
    user = box(b"udta", box(b"meta", bytes(4), handler, box(b"ilst", cover)))
    parts = [box(kind, body) for kind, body, _ in boxes(moov)]
    return before + box(b"moov", parts[0], user, *parts[1:])


def with_edits(mp4: bytes, edits: Sequence[tuple[float, float]]) -> bytes:
    """The file with an edit list: seconds of media from a start; start -1: so long nothing."""
    before, moov = moov_of(mp4)
    header = next(body for kind, body, _ in boxes(moov) if kind == b"mvhd")
    movie = struct.unpack_from(">I", header, 12)[0]
    media = struct.unpack_from(">I", moov, moov.index(b"mdhd") + 16)[0]
    rows = b"".join(
        struct.pack(">Iihh", round(length * movie), -1 if at < 0 else round(at * media), 1, 0)
        for at, length in edits
    )
    table = box(b"edts", box(b"elst", struct.pack(">2I", 0, len(edits)), rows))

    def edited(track: bytes) -> bytes:
        parts = [box(kind, body) for kind, body, _ in boxes(track) if kind != b"edts"]
        return parts[0] + table + b"".join(parts[1:])

    return before + box(b"moov", changed(moov, [b"trak"], edited))


def with_aspect(mp4: bytes, across: int, down: int) -> bytes:
    """The file of a track whose pixels have this width to height."""
    before, moov = moov_of(mp4)
    shape = box(b"pasp", struct.pack(">2I", across, down))

    def described(table: bytes) -> bytes:
        entry = table[16:]
        inner = [box(kind, body) for kind, body, _ in boxes(entry[78:]) if kind != b"pasp"]
        return table[:8] + box(table[12:16], entry[:78], *inner, shape)

    path = [b"trak", b"mdia", b"minf", b"stbl", b"stsd"]
    return before + box(b"moov", changed(moov, path, described))


# Matroska


def element(kind: int, *parts: bytes) -> bytes:
    """An element of EBML."""
    body = b"".join(parts)
    name = kind.to_bytes((kind.bit_length() + 7) // 8)
    return name + (1 << 56 | len(body)).to_bytes(8) + body


def whole(value: int) -> bytes:
    """A whole number as an element has it."""
    return value.to_bytes(4)


Packets = Sequence[tuple[int, bytes]]
"""Times in ms, and what is to be decoded."""


def matroska(tracks: Sequence[tuple[str, int, int, bool, Packets]]) -> bytes:
    """A file of video tracks: codec, width, height, whether it is a default track, and packets."""
    entries: list[bytes] = []
    clusters: list[tuple[int, int, bytes]] = []
    for number, (codec, width, height, default, packets) in enumerate(tracks, start=1):
        size = element(0xE0, element(0xB0, whole(width)), element(0xBA, whole(height)))
        names = element(0xD7, whole(number)), element(0x73C5, whole(number))
        kinds = element(0x83, whole(1)), element(0x88, whole(default))
        entries.append(element(0xAE, *names, *kinds, element(0x86, codec.encode()), size))
        for ms, data in packets:
            head = bytes([0x80 | number, 0, 0, 0x80])
            block = element(0xE7, whole(ms)) + element(0xA3, head, data)
            clusters.append((ms, number, element(0x1F43B675, block)))
    last = max(ms for ms, _, _ in clusters)
    clock = element(0x2AD7B1, whole(1_000_000)), element(0x4489, struct.pack(">d", last + 40.0))
    ordered = (cluster for _, _, cluster in sorted(clusters))
    kinds = element(0x4282, b"matroska"), element(0x4287, whole(4)), element(0x4285, whole(2))
    info, held = element(0x1549A966, *clock), element(0x1654AE6B, *entries)
    return element(0x1A45DFA3, *kinds) + element(0x18538067, info, held, *ordered)


def packets_of(file: Path, start_ms: int = 0) -> list[tuple[int, bytes]]:
    """What is to be decoded of a video's frames."""
    capture = cv2.VideoCapture(str(file), cv2.CAP_FFMPEG, [cv2.CAP_PROP_FORMAT, -1])
    found: list[tuple[int, bytes]] = []
    while True:
        read, data = capture.read()
        if not read:
            return found
        ms = round(capture.get(cv2.CAP_PROP_POS_MSEC))
        found.append((start_ms + ms, np.asarray(data).tobytes()))
