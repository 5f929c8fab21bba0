"""Recorder: every logged message of every topic, in one MCAP file.

in   everything that is logged
out  the recording

A sender gets its credit back only for what is safe on the disk.
"""

import time
import zlib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from pliant.bus.base import ObserverBus, Received
from pliant.config import Config, RecorderParameters, config_yaml
from pliant.messages import codec, topics
from pliant.messages.types import CameraStream, SourceImage
from pliant.recording.parts import RollingWriter
from pliant.recording.recover import mend


def run(
    bus: ObserverBus,
    config: Config,
    output: Path,
    metadata: Mapping[str, Mapping[str, str]],
    restartable: bool = False,
) -> None:
    """Record until every topic has ended, putting all on the disk at least every second.

    restartable: continue behind what an earlier recorder of this run has put there, in a new part.
    """
    limits = config.recorder
    if restartable:
        bus.start_from(*mend(output))
    with RollingWriter(
        output,
        metadata,
        roll_bytes=limits.roll_mib << 20,
        roll_ns=int(limits.roll_s * 1e9),
        append=restartable,
    ) as recording:
        recording.attach("config.yaml", "application/yaml", config_yaml(config).encode())
        unsafe = _Unsafe(limits)
        now_ns = 0
        for received in bus.receive_any(timeout_s=unsafe.look_every_s):
            if received is not None:
                now_ns = max(now_ns, time.time_ns())  # the clock may be set back
                _record(recording, received, now_ns)
                unsafe.add(received)
            if unsafe.due():
                recording.sync()
                bus.acknowledge()
                unsafe = _Unsafe(limits)
    bus.acknowledge()  # closed, and on the disk


def _record(recording: RollingWriter, received: Received, now_ns: int) -> None:
    topic = topics.STREAM_END if received.is_end else received.topic
    message = received.message or codec.decode(topic.message, received.data, views=True)
    if isinstance(message, CameraStream):
        recording.attach("calibration.yaml", "application/yaml", message.calibration.encode())
    data = received.data
    if isinstance(message, SourceImage) and message.clip_frame >= 0:  # the clip has the pixels
        checksum = zlib.crc32(message.data)
        data = codec.encode(replace(message, data=b"", checksum=checksum))
    recording.write(
        topic,
        data,
        sequence=received.sequence,
        log_time_ns=now_ns,
        publish_time_ns=message.stamp_ns,
    )


class _Unsafe:
    """Data that is not yet on the disk, until it is too old or half of the senders' windows."""

    def __init__(self, limits: RecorderParameters) -> None:
        self.look_every_s = limits.sync_interval_s / 4
        self._deadline = time.monotonic() + 3 * self.look_every_s
        self._most_messages = limits.window_messages // 2
        self._most_bytes = (limits.window_mib << 20) // 2
        self._messages: dict[str, int] = {}
        self._bytes = 0

    def add(self, received: Received) -> None:
        key = received.topic.key
        self._messages[key] = self._messages.get(key, 0) + 1
        self._bytes += len(received.data)

    def due(self) -> bool:
        if not self._messages:
            return False
        return (
            time.monotonic() >= self._deadline
            or self._bytes >= self._most_bytes
            or max(self._messages.values()) >= self._most_messages
        )
