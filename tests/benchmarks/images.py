"""Images of a source made smaller for a link: how small, and what it costs on either side."""

import time
from collections.abc import Callable, Iterator
from itertools import islice
from typing import Any

import cv2
import numpy as np

from benchmarks.table import markdown
from pliant.datasets import open_source
from pliant.datasets.rectifier import Rectifier, decode, rectified
from pliant.messages import codec
from pliant.messages.types import Image

_PNG = (
    ("PNG, level 1", [cv2.IMWRITE_PNG_COMPRESSION, 1]),
    (
        "PNG, row differences, Huffman alone",
        [
            *(cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP),
            *(cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY),
        ],
    ),
)
_Work = tuple[Callable[[], bytes], Callable[[bytes], object]]


def measure(source: str, frames: int) -> Iterator[str]:
    """Means over so many frames, evenly spread, of the better of two times each."""
    dataset = open_source(source)
    step = max(1, (dataset.frame_count or frames) // frames)
    rectifier = Rectifier(dataset.calibration)
    rows: dict[str, list[tuple[float, float, float]]] = {}
    raw = 0
    for frame in islice(dataset, 0, frames * step, step):
        image, pixels = rectified(frame, rectifier), decode(frame)
        raw = image.grey.nbytes + image.colour.nbytes
        for name, work in _ways(image, pixels).items():
            encode_ms, data = _time(work[0])
            decode_ms, _ = _time(lambda work=work, data=data: work[1](data))
            rows.setdefault(name, []).append((len(data), encode_ms, decode_ms))
        rectify_ms, _ = _time(lambda frame=frame: rectified(frame, rectifier))
        rows.setdefault("the source's own bytes, decoded and rectified", []).append(
            (len(frame.data), 0.0, rectify_ms)
        )
    means = {name: np.mean(found, axis=0) for name, found in rows.items()}
    yield markdown(
        (f"{source}, {raw / 1e3:.0f} kB of pixels", "share", "to pack, ms", "to unpack, ms"),
        [(n, f"{m[0] / raw:.2f}", f"{m[1]:.2f}", f"{m[2]:.2f}") for n, m in means.items()],
    )


def _ways(image: Image, pixels: np.ndarray) -> dict[str, _Work]:
    shown = image.colour if image.colour.size else image.grey
    ways: dict[str, _Work] = {
        "raw message": (
            lambda: codec.encode(image),
            lambda data: codec.decode(Image, data),
        ),
        "lossless: row differences, zstd": (
            lambda: codec.encode(image, packed=True),
            lambda data: codec.decode(Image, data),
        ),
    }
    for name, how in _PNG:
        ways[f"{name}{', colour alone' if image.colour.size else ''}"] = (
            lambda how=how: cv2.imencode(".png", shown, how)[1].tobytes(),
            lambda data: cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_ANYCOLOR),
        )
    for quality in (75, 90, 95):
        ways[f"JPEG, quality {quality}"] = (
            lambda quality=quality: cv2.imencode(
                ".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, quality]
            )[1].tobytes(),
            lambda data: cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_ANYCOLOR),
        )
    return ways


def _time(work: Callable[[], Any]) -> tuple[float, Any]:
    best_s, made = float("inf"), None
    for _ in range(2):
        start = time.perf_counter()
        made = work()
        best_s = min(best_s, time.perf_counter() - start)
    return 1e3 * best_s, made
