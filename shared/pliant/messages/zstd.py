"""Compression by zstd: a compressor is costly to make and for one thread at a time."""

import threading

import zstandard

_OF_THREAD = threading.local()


def compress(data: bytes | memoryview, level: int) -> bytes:
    """One zstd frame that states its content's size."""
    compressors: dict[str, zstandard.ZstdCompressor] = _OF_THREAD.__dict__
    name = f"level {level}"
    if name not in compressors:
        compressors[name] = zstandard.ZstdCompressor(level=level)
    return compressors[name].compress(data)
