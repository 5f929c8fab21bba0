"""Buses over real Zenoh sessions, for their tests."""

import threading

import numpy as np

from pliant.bus.zenoh_bus import ZenohBus
from pliant.messages import topics
from pliant.messages.types import CameraStream, Image

WINDOW = 4


PATIENCE_S = 20.0


def image(frame: int) -> Image:
    return Image(
        frame=frame,
        stamp_ns=frame,
        frame_id="camera",
        grey=np.full((48, 64), frame % 256, np.uint8),
        colour=np.zeros((0, 0, 3), np.uint8),
    )


def camera_stream(mode: str) -> CameraStream:
    return CameraStream(
        frame=0, stamp_ns=0, frame_id="camera", source="test", mode=mode, frames=-1,
        calibration="", width=64, height=48, fx=60.0, fy=60.0, cx=31.5, cy=23.5,
    )  # fmt: skip


def reader(endpoint: str, name: str = "tracking") -> ZenohBus:
    return ZenohBus(
        endpoints=[endpoint],
        session="test",
        service=name,
        inputs={topics.IMAGE: "ingest"},
        outputs={},
        window=WINDOW,
    )


def writer(endpoint: str, *readers: str) -> ZenohBus:
    return ZenohBus(
        endpoints=[endpoint],
        session="test",
        service="ingest",
        inputs={},
        outputs={topics.IMAGE: readers or ("tracking",)},
        window=WINDOW,
    )


def die(bus: ZenohBus) -> None:
    """End as a killed process does: without a word."""
    bus._keeper.stop()
    bus._session.close()


def in_thread(function) -> tuple[threading.Thread, list[object]]:
    result: list[object] = []

    def run() -> None:
        try:
            result.append(function())
        except Exception as error:
            result.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    return thread, result


def write(endpoint: str, frames: int) -> None:
    with writer(endpoint) as bus:
        for frame in range(frames):
            bus.publish(topics.IMAGE, image(frame))
        bus.end_all()
