"""ROS messages by name: made with zeros for absent fields, and as CDR.

Definitions and type hashes (REP-2016) are those of ROS 2 Jazzy, by the library rosbags; the types
that are used here are the same in Kilted.
"""

import importlib
from functools import cache
from typing import Any

import numpy as np

from pliant.errors import PliantError


class RosError(PliantError):
    """ROS cannot be spoken to."""


@cache
def definitions() -> Any:
    """rosbags' store of types.  Raises RosError if rosbags is missing."""
    try:
        typesys: Any = importlib.import_module("rosbags.typesys")
    except ImportError:
        raise RosError("ROS messages need rosbags: pip install 'pliant[bags]'") from None
    return typesys.get_typestore(typesys.Stores.ROS2_JAZZY)


@cache
def type_hash(kind: str) -> str:
    """The hash of a type such as sensor_msgs/msg/Image: RIHS01_..."""
    hashed: str = definitions().hash_rihs01(kind)
    return hashed


def serialised(message: Any) -> bytes:
    """A message as little-endian CDR."""
    return bytes(definitions().serialize_cdr(message, message.__msgtype__))


def made(kind: str, **given: Any) -> Any:
    """A message of a type; what is not said is zero or empty.

    A field that is a message takes it, or a dictionary of its fields.
    """
    store = definitions()
    values: dict[str, Any] = {}
    for name, (node, detail) in store.get_msgdef(kind).fields:
        value = given.pop(name, None)
        if node.name == "NAME" and (value is None or isinstance(value, dict)):
            value = made(detail, **(value or {}))
        elif node.name in ("ARRAY", "SEQUENCE"):
            (inner, (base, *_)), length = detail
            if inner.name == "BASE" and base != "string":
                value = np.zeros(length, base) if value is None else np.asarray(value, base)
            elif value is None:
                value = []
        elif value is None:
            value = "" if detail[0] == "string" else 0
        values[name] = value
    if given:
        raise TypeError(f"{kind} has no {', '.join(given)}")
    return store.types[kind](**values)


def header(stamp_ns: int, frame_id: str) -> dict[str, Any]:
    """The fields of a std_msgs/msg/Header."""
    return {
        "stamp": {"sec": stamp_ns // 10**9, "nanosec": stamp_ns % 10**9},
        "frame_id": frame_id,
    }
