"""What telephones write into an MP4: how the image is turned, and frames at unequal times."""

import struct
from collections.abc import Sequence

_MATRICES = {90: (0, 1, -1, 0), 180: (-1, 0, 0, -1), 270: (0, -1, 1, 0)}
"""Of a track header, by the degrees clockwise by which a player turns the image: a b c d."""
_MATRIX = 44
"""Where it begins behind the name ``tkhd``, of version 0."""


def turned(mp4: bytes, degrees: int) -> bytes:
    """The file of a track that a player shows turned clockwise."""
    at = mp4.index(b"tkhd") + _MATRIX
    a, b, c, d = (part << 16 for part in _MATRICES[degrees])
    matrix = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
    return mp4[:at] + matrix + mp4[at + len(matrix) :]


def spaced(mp4: bytes, ticks: Sequence[int]) -> bytes:
    """The file whose frames take so many ticks of its track's clock each, as many as before in all.

    Its index lies behind its frames, as OpenCV writes it, so nothing that points at these moves.
    """
    assert mp4.index(b"mdat") < mp4.index(b"moov")
    entries = b"".join(struct.pack(">2I", 1, each) for each in ticks)
    table = struct.pack(">I4s2I", 16 + len(entries), b"stts", 0, len(ticks)) + entries
    at = mp4.index(b"stts") - 4
    old = struct.unpack_from(">I", mp4, at)[0]
    made = bytearray(mp4[:at] + table + mp4[at + old :])
    for box in (b"moov", b"trak", b"mdia", b"minf", b"stbl"):
        start = made.index(box, made.index(b"moov")) - 4
        size = struct.unpack_from(">I", made, start)[0]
        struct.pack_into(">I", made, start, size + len(table) - old)
    return bytes(made)


def ticks_a_second(mp4: bytes) -> int:
    """Of the track's clock."""
    return struct.unpack_from(">I", mp4, mp4.index(b"mdhd") + 16)[0]
