"""ROS bags: a ROS 1 ``.bag`` file, or a ROS 2 folder with ``metadata.yaml`` (sqlite3 or MCAP).

Read by the library rosbags, without ROS: ``pip install 'pliant[bags]'``.
"""

import importlib
import warnings
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from pliant.datasets.base import Dataset
from pliant.datasets.image_messages import RecordedImage, plain_type
from pliant.datasets.measured.base import Measurements
from pliant.datasets.measured.message_topics import sensors_of
from pliant.datasets.message_files import (
    MessageImages,
    MessageTopic,
    damaged,
    missing_library,
    recorded_image,
)
from pliant.datasets.source_spec import SourceSpec
from pliant.errors import PliantError

_HINT = "`rosbag reindex` (ROS 1) or `ros2 bag reindex` (ROS 2)"


def is_ros_bag(source: str) -> bool:
    """Whether it is a bag of ROS 1 or the folder of one of ROS 2."""
    path = Path(source)
    return (path.suffix == ".bag" and path.is_file()) or (path / "metadata.yaml").is_file()


def open_ros_bag(spec: SourceSpec) -> Dataset:
    """The images of a bag.  Raises DatasetError and CalibrationError."""
    return MessageImages(_Bag(Path(spec.location)), spec)


def bag_sensors(spec: SourceSpec) -> Measurements:
    """The other sensors of a bag.  Raises DatasetError."""
    return sensors_of(_Bag(Path(spec.location)), spec)


class _Bag:
    def __init__(self, path: Path) -> None:
        self.path = path

    @contextmanager
    def open(self) -> Generator["_OpenBag"]:
        try:
            highlevel: Any = importlib.import_module("rosbags.highlevel")
            typesys: Any = importlib.import_module("rosbags.typesys")
        except ImportError:
            raise missing_library(self.path, "rosbags") from None
        # Bags of old ROS 2 releases hold no definitions; those of image messages never changed.
        store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        try:
            reader: Any = highlevel.AnyReader([self.path], default_typestore=store)
            reader.open()
        except Exception as error:  # of a foreign parser on a foreign file
            raise damaged(self.path, error, _HINT) from None
        try:
            yield _OpenBag(self.path, reader)
        finally:
            with warnings.catch_warnings(action="ignore"):
                reader.close()


class _OpenBag:
    def __init__(self, path: Path, reader: Any) -> None:
        self._path = path
        self._reader = reader
        self.topics = [
            MessageTopic(name, plain_type(info.msgtype or "several types"), info.msgcount)
            for name, info in sorted(reader.topics.items())
        ]

    def messages(self, topic: MessageTopic) -> Iterator[RecordedImage]:
        """The messages of one topic in order of time."""
        chosen = [c for c in self._reader.connections if c.topic == topic.name]
        try:
            for connection, time_ns, data in self._reader.messages(connections=chosen):
                decode = partial(self._decoded, connection.msgtype)
                yield recorded_image(time_ns, decode, data)
        except (PliantError, GeneratorExit):
            raise
        except Exception as error:  # of a foreign parser on a foreign file
            raise damaged(self._path, error, _HINT) from None

    def _decoded(self, kind: str, data: bytes) -> Any:
        return self._reader.deserialize(data, kind)
