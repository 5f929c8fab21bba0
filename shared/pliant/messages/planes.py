"""Planes: the form of wide numbers in recordings, which zstd compresses better.

The lowest bytes of all numbers come first, then the next ones of all, up to the highest.  So the
bytes that are alike, those of signs, exponents and the high ends of counters, lie together:
``scripts/bench compression`` measures the gain.
"""

from typing import Any

import msgpack
import numpy as np

from pliant.algorithms.arrays import U8, array_fields
from pliant.errors import MessageError

CODE = 2
"""Code of the msgpack extension."""

_LEAST_BYTES = 1024  # below that there is nothing to gain


def in_planes(message: type, data: bytes) -> bytes:
    """The bytes of an encoded message with its arrays in planes; unchanged without arrays."""
    widths = {a.name: a.dtype.itemsize for a in array_fields(message) if a.dtype.itemsize > 1}
    if not widths or len(data) < _LEAST_BYTES:
        return data
    try:
        content: Any = msgpack.unpackb(data, raw=False)
        for name, width in widths.items():
            _, raw = array = content.get(name, [[], b""])
            if isinstance(raw, bytes) and len(raw) >= _LEAST_BYTES:
                table = np.frombuffer(raw, np.uint8).reshape(len(raw) // width, width)
                array[1] = msgpack.ExtType(CODE, table.T.tobytes())
        packer = msgpack.Packer(use_bin_type=True, buf_size=len(data) + 4096)
        packed = packer.pack(content)
    except Exception:  # msgpack raises many unrelated types on hostile bytes
        return data
    assert isinstance(packed, bytes)
    return packed


def whole(where: str, value: msgpack.ExtType, width: int) -> U8:
    """The bytes (n,) of numbers of some width, of our own memory.

    Raises MessageError for everything that ``in_planes`` did not make.
    """
    if value.code != CODE or len(value.data) % width:
        raise MessageError(f"{where}: not in planes as arrays of recordings are")
    table = np.frombuffer(value.data, np.uint8).reshape(width, len(value.data) // width)
    return np.ascontiguousarray(table.T).reshape(-1)
