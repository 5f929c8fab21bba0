"""Writes GoPro's metadata, and an MP4 file with a track of it, as the formats are described."""

import struct
from collections.abc import Sequence
from typing import Any


def entry(key: str, kind: str, each: int, rows: Sequence[Sequence[Any]] | bytes) -> bytes:
    """An entry of rows of numbers, or of bytes as they are; ``each`` numbers of ``kind`` a row."""
    if isinstance(rows, bytes):
        size, count, data = 1, len(rows), rows
    else:
        size = each * struct.calcsize(f">{_LETTER.get(kind, kind)}")
        count = len(rows)
        data = b"".join(struct.pack(f">{each}{_LETTER.get(kind, kind)}", *row) for row in rows)
    head = key.encode() + (kind.encode() if kind else b"\0")
    return head + bytes([size]) + struct.pack(">H", count) + data + bytes(-len(data) % 4)


_LETTER = {"s": "h", "S": "H", "l": "i", "L": "I", "j": "q", "J": "Q"}


def nested(key: str, *parts: bytes) -> bytes:
    """An entry of entries."""
    return entry(key, "", 1, b"".join(parts))


def stream(key: str, rows: Sequence[Sequence[int]], scale: int, *about: bytes) -> bytes:
    """A stream of 16-bit samples."""
    told = [*about, entry("SCAL", "s", 1, [[scale]])]
    return nested("STRM", *told, entry(key, "s", len(rows[0]), rows))


def box(kind: bytes, *parts: bytes) -> bytes:
    """A box of MP4."""
    data = b"".join(parts)
    return struct.pack(">I", 8 + len(data)) + kind + data


def mp4(payloads: Sequence[bytes], each_ms: int = 1001) -> bytes:
    """A file with nothing but a track of metadata."""
    ftyp = box(b"ftyp", b"mp41", bytes(4))
    begin, offsets = len(ftyp) + 8, list[int]()
    for payload in payloads:
        offsets.append(begin)
        begin += len(payload)
    count = len(payloads)
    table = box(
        b"stbl",
        box(b"stsd", bytes(4), struct.pack(">I", 1), box(b"gpmd", bytes(8))),
        box(b"stts", bytes(4), struct.pack(">III", 1, count, each_ms)),
        box(b"stsc", bytes(4), struct.pack(">IIII", 1, 1, 1, 1)),
        box(b"stsz", bytes(4), struct.pack(f">II{count}I", 0, count, *map(len, payloads))),
        box(b"stco", bytes(4), struct.pack(f">I{count}I", count, *offsets)),
    )
    mdhd = box(b"mdhd", bytes(12), struct.pack(">II", 1000, count * each_ms), bytes(4))
    hdlr = box(b"hdlr", bytes(8), b"meta", bytes(12))
    track = box(b"trak", box(b"tkhd", bytes(84)), box(b"mdia", mdhd, hdlr, box(b"minf", table)))
    moov = box(b"moov", box(b"mvhd", bytes(12), struct.pack(">I", 1000), bytes(84)), track)
    return ftyp + box(b"mdat", *payloads) + moov
