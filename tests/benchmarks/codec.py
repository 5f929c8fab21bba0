"""Cost of a message: packing and unpacking a 361 kB image."""

import time
from collections.abc import Iterator

import numpy as np

from benchmarks.table import markdown
from pliant.messages import codec
from pliant.messages.types import Image

_ROUNDS, _REPEATS = 20, 50


def measure() -> Iterator[str]:
    """Median times over rounds of repetitions, and the ratio to a bare copy."""
    grey = np.random.default_rng(0).integers(0, 256, (480, 752), np.uint8)
    colour = np.zeros((0, 0, 3), np.uint8)
    image = Image(frame=0, stamp_ns=0, frame_id="camera", grey=grey, colour=colour)
    wire = codec.encode(image)
    copy = _microseconds(grey.tobytes)
    pack = _microseconds(lambda: codec.encode(image))
    unpack = _microseconds(lambda: codec.decode(Image, wire))
    yield markdown(
        ["752x480 image, 361 kB", "us", "copies"],
        [
            ["one copy", f"{copy:.1f}", "1.0"],
            ["pack", f"{pack:.1f}", f"{pack / copy:.1f}"],
            ["unpack and check", f"{unpack:.1f}", f"{unpack / copy:.1f}"],
        ],
    )


def _microseconds(function) -> float:
    rounds = []
    for _ in range(_ROUNDS):
        start = time.perf_counter()
        for _ in range(_REPEATS):
            function()
        rounds.append(time.perf_counter() - start)
    return 1e6 * float(np.median(rounds)) / _REPEATS
