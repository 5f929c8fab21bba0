"""MCAP files of others: ROS 2 and ROS 1 messages, Foxglove messages as protobuf or JSON.

ROS messages are read by the library rosbags, protobuf by Google's: ``pip install 'pliant[bags]'``.
"""

import base64
import importlib
import json
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from mcap.reader import make_reader
from mcap.records import Schema

from pliant.datasets.base import Dataset
from pliant.datasets.image_messages import (
    CALIBRATION_TYPES,
    IMAGE_TYPES,
    RecordedImage,
    plain_type,
)
from pliant.datasets.measured.base import Measurements
from pliant.datasets.measured.message_topics import FIX_TYPES, IMU_TYPES, sensors_of
from pliant.datasets.message_files import (
    MessageImages,
    MessageTopic,
    damaged,
    missing_library,
    recorded_image,
)
from pliant.datasets.source_spec import SourceSpec
from pliant.errors import DatasetError, PliantError
from pliant.wording import shortened, shown

MAGIC = b"\x89MCAP0\r\n"
_HINT = "`mcap recover`"
_Decoder = Callable[[bytes], Any]


def is_mcap(source: str) -> bool:
    """Whether it is a file that begins as MCAP does, or is called so."""
    path = Path(source)
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(MAGIC)) == MAGIC or path.suffix == ".mcap"


def open_mcap(spec: SourceSpec) -> Dataset:
    """The images of an MCAP file.  Raises DatasetError and CalibrationError."""
    return MessageImages(_Mcap(Path(spec.location)), spec)


def mcap_sensors(spec: SourceSpec) -> Measurements:
    """The other sensors of an MCAP file.  Raises DatasetError."""
    return sensors_of(_Mcap(Path(spec.location)), spec)


class _Mcap:
    def __init__(self, path: Path) -> None:
        self.path = path

    @contextmanager
    def open(self) -> Generator["_OpenMcap"]:
        with self.path.open("rb") as file:
            try:
                reader = make_reader(file)
                summary = reader.get_summary()
            except Exception as error:  # of a foreign parser on a foreign file
                raise damaged(self.path, error, _HINT) from None
            if summary is None or (summary.chunk_indexes == [] and not summary.channels):
                raise DatasetError(
                    f"{self.path}: is truncated or was never closed: it has no index; repair it "
                    f"with {_HINT}"
                )
            yield _OpenMcap(self.path, reader, summary)


class _OpenMcap:
    def __init__(self, path: Path, reader: Any, summary: Any) -> None:
        self._path = path
        self._reader = reader
        self._decoders: dict[int, _Decoder] = {}
        counts = summary.statistics.channel_message_counts if summary.statistics else None
        found: dict[str, MessageTopic] = {}
        for channel in sorted(summary.channels.values(), key=lambda channel: channel.id):
            schema = summary.schemas.get(channel.schema_id)
            kind = plain_type(schema.name) if schema else "no type"
            count = -1 if counts is None else counts.get(channel.id, 0)
            before = found.get(channel.topic)
            if before is not None and before.kind == kind and min(count, before.count) >= 0:
                count += before.count  # several writers of one topic
            found[channel.topic] = MessageTopic(channel.topic, kind, count)
        self.topics = list(found.values())

    def messages(self, topic: MessageTopic) -> Iterator[RecordedImage]:
        """The messages of one topic in order of time."""
        try:
            for schema, channel, message in self._reader.iter_messages(topics=[topic.name]):
                decode = self._decoders.get(channel.id)
                if decode is None:
                    decode = _decoder(self._path, schema, channel.message_encoding)
                    self._decoders[channel.id] = decode
                yield recorded_image(message.log_time, decode, message.data)
        except (PliantError, GeneratorExit):
            raise
        except Exception as error:  # of a foreign parser on a foreign file
            raise damaged(self._path, error, _HINT) from None


def _decoder(path: Path, schema: Schema | None, encoding: str) -> _Decoder:
    assert schema is not None
    assert plain_type(schema.name) in (
        *(*IMAGE_TYPES, *CALIBRATION_TYPES),
        *(*IMU_TYPES, *FIX_TYPES),
    )
    if encoding in ("cdr", "ros1"):
        return _ros_decoder(path, schema, encoding)
    if encoding == "protobuf":
        return _protobuf_decoder(path, schema)
    if encoding == "json":
        return _from_json
    raise DatasetError(
        f"{path}: {shortened(schema.name)} encoded as {shown(encoding)} is not supported: use "
        "cdr, ros1, protobuf or json"
    )


def _ros_decoder(path: Path, schema: Schema, encoding: str) -> _Decoder:
    try:
        typesys: Any = importlib.import_module("rosbags.typesys")
    except ImportError:
        raise missing_library(path, "rosbags") from None
    name = schema.name if "/msg/" in schema.name else schema.name.replace("/", "/msg/")
    text = schema.data.decode()
    store = typesys.get_typestore(typesys.Stores.EMPTY)
    idl = schema.encoding == "ros2idl"
    store.register(
        typesys.get_types_from_idl(text) if idl else typesys.get_types_from_msg(text, name)
    )
    read = store.deserialize_cdr if encoding == "cdr" else store.deserialize_ros1
    return lambda data: read(data, name)


def _protobuf_decoder(path: Path, schema: Schema) -> _Decoder:
    """By the definitions in the file itself."""
    try:
        descriptors: Any = importlib.import_module("google.protobuf.descriptor_pb2")
        pools: Any = importlib.import_module("google.protobuf.descriptor_pool")
        factory: Any = importlib.import_module("google.protobuf.message_factory")
    except ImportError:
        raise missing_library(path, "protobuf") from None
    pool = pools.DescriptorPool()
    for file in descriptors.FileDescriptorSet.FromString(schema.data).file:
        pool.Add(file)
    kind = factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))
    return lambda data: kind.FromString(data)


def _from_json(data: bytes) -> Any:
    message = json.loads(data, object_hook=lambda fields: SimpleNamespace(**fields))
    if hasattr(message, "data"):
        message.data = base64.b64decode(message.data)
    return message
