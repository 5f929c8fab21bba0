"""A camera of ROS 2 that is publishing: ``ros:localhost``, by rmw_zenoh's keys, without ROS.

The source is the machine of rmw_zenoh's router, ``--topic`` chooses the images.  It is live, and
ends when the images are no longer published.  Inertial samples and satellite fixes are heard
meanwhile.
"""

import queue
import time
from collections.abc import Generator, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

from pliant.algorithms.inertial.samples import ImuSamples
from pliant.bus.session import open_session
from pliant.datasets.base import Dataset
from pliant.datasets.image_messages import RecordedImage, capture_time, plain_type
from pliant.datasets.measured.base import Measurements
from pliant.datasets.measured.message_topics import ImuStream, fixes_of, sensor_topics
from pliant.datasets.message_files import MessageImages, MessageTopic, recorded_image
from pliant.datasets.source_spec import SourceSpec
from pliant.errors import BusError, DatasetError
from pliant.ros.definitions import RosError, definitions
from pliant.ros.graph import Node, RosTopic

_PREFIX = "ros:"
_PORT = 7447
_WAITING = 16  # messages between the network and the reader; beyond, the oldest are dropped
_FIRST_S = 10.0  # for the first message of a topic
_ASK_S = 0.5


def open_ros(spec: SourceSpec) -> Dataset:
    """The images of a topic.  Raises DatasetError and CalibrationError."""
    return RosCamera(spec)


class RosCamera(MessageImages):
    """The images of a topic as they come."""

    is_live = True

    def __init__(self, spec: SourceSpec) -> None:
        """Raises DatasetError and CalibrationError."""
        graph = _Graph(spec.location)
        super().__init__(graph, spec)
        self.name = spec.location
        self._spec, self._heard = spec, graph.heard
        imu, fixes = list[MessageTopic](), list[MessageTopic]()
        with graph.open() as opened:
            try:
                imu, fixes = sensor_topics(opened, spec, graph)
            except DatasetError as error:
                if spec.imu or spec.gps:
                    raise
                self.notes.append(str(error))
        self._heard.topics, self._fixes = [*imu, *fixes], fixes
        self.has_imu = bool(imu)
        self._imu = ImuStream(self._heard, imu)

    def next_imu(self) -> ImuSamples:
        """Inertial samples since the last call, or since the first image; of a source with any."""
        return self._imu.take()

    def heard(self) -> Measurements:
        """Satellite fixes since the first image."""
        return fixes_of(self._heard, self._fixes, self._heard)


class _Heard:
    """Messages of sensors as they have come, as a file of messages: decoded they are ten times as
    large."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.topics: list[MessageTopic] = []
        self.came: dict[str, list[tuple[int, str, bytes]]] = {}

    @contextmanager
    def open(self) -> Generator["_Heard"]:
        yield self

    def messages(self, topic: MessageTopic) -> Iterator[RecordedImage]:
        """The messages of a topic since the last call."""
        came = self.came.get(topic.name, [])
        new = came[:]
        del came[: len(new)]  # meanwhile more may have come
        for arrived_ns, kind, data in new:
            yield recorded_image(arrived_ns, partial(_decoded, kind), data)


class _Graph:
    def __init__(self, source: str) -> None:
        host = source.removeprefix(_PREFIX) or "localhost"
        has_port = host.rpartition(":")[2].isdecimal() and not host.endswith("]")
        self.path = Path(source)
        self._endpoint = f"tcp/{host}" if has_port else f"tcp/{host}:{_PORT}"
        self.heard = _Heard(self.path)

    @contextmanager
    def open(self) -> Generator["_OpenGraph"]:
        try:
            definitions()  # fails now, before the network is used
            with open_session([self._endpoint]) as session:
                yield _OpenGraph(self.path, Node(session, "/pliant_camera"), self.heard)
        except (BusError, RosError) as error:
            raise DatasetError(f"{self.path}: {error}") from None


class _OpenGraph:
    def __init__(self, path: Path, node: Node, heard: _Heard) -> None:
        self._path, self._node, self._heard = path, node, heard
        self._published = {topic.name: topic for topic in node.published()}
        self.topics = [
            MessageTopic(topic.name, plain_type(topic.kind), -1)
            for topic in self._published.values()
        ]

    def messages(self, topic: MessageTopic) -> Iterator[RecordedImage]:
        """The messages of a topic as they come; those of sensors are heard meanwhile."""
        ros = self._published[topic.name]
        waiting: queue.Queue[tuple[int, bytes]] = queue.Queue(_WAITING)

        def take(data: bytes) -> None:
            if waiting.full():
                with suppress(queue.Empty):
                    waiting.get_nowait()
            waiting.put((time.time_ns(), data))

        self._heard.came = {each.name: [] for each in self._heard.topics}
        subscribers = [self._node.subscribe(ros, take)]
        for each in self._heard.topics:
            if each.name in self._published:  # else it has ended since
                subscribers.append(self._listen(self._published[each.name]))
        deadline, last_ns = time.monotonic() + _FIRST_S, -1
        try:
            while True:
                try:
                    arrived_ns, data = waiting.get(timeout=_ASK_S)
                except queue.Empty:
                    if last_ns < 0 and time.monotonic() > deadline:
                        raise DatasetError(
                            f"{self._path}: {topic.name}: no message arrived within "
                            f"{_FIRST_S:.0f} s"
                        ) from None
                    if ros.name not in {there.name for there in self._node.published()}:
                        return
                    continue
                image = recorded_image(arrived_ns, partial(_decoded, ros.kind), data)
                if image.fault or capture_time(image) != last_ns:  # a driver may tell one twice
                    last_ns = last_ns if image.fault else capture_time(image)
                    yield image
        finally:
            for subscriber in subscribers:
                subscriber.undeclare()

    def _listen(self, ros: RosTopic) -> Any:
        came = self._heard.came[ros.name]

        def take(data: bytes) -> None:
            came.append((time.time_ns(), ros.kind, data))

        return self._node.subscribe(ros, take)


def _decoded(kind: str, data: bytes) -> object:
    return definitions().deserialize_cdr(data, kind)
