"""A node in the graph of ROS 2, as rmw_zenoh lays it out on Zenoh's keys.

Layout: docs/design.md of https://github.com/ros2/rmw_zenoh, and its liveliness_utils.cpp and
attachment_helpers.cpp: rmw_zenoh_cpp 0.2.4 of Jazzy (April 2025) and later.
"""

import hashlib
import os
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import zenoh

from pliant.ros.definitions import RosError, type_hash

_SPACE = "@ros2_lv"
_NODE_ID, _FIRST_ENTITY = 0, 1
_DEPTH = 10
_QOS = f"::,{_DEPTH}:,:,:,,"
"""As ``qos_to_keyexpr`` writes reliable, volatile, the last ``_DEPTH``: what is default is left
out."""
_LARGEST_DOMAIN = 232


def domain_id() -> int:
    """ROS_DOMAIN_ID, 0 where it is not set.  Raises RosError if it is no domain."""
    domain = os.environ.get("ROS_DOMAIN_ID", "") or "0"
    if not domain.isdecimal() or int(domain) > _LARGEST_DOMAIN:
        raise RosError(f"ROS_DOMAIN_ID={domain}: not a number from 0 to {_LARGEST_DOMAIN}")
    return int(domain)


@dataclass(frozen=True)
class RosTopic:
    """A topic.  name: /with/slashes.    kind: sensor_msgs/msg/Image.    hash: of the type."""

    name: str
    kind: str
    hash: str

    @classmethod
    def of(cls, name: str, kind: str) -> "RosTopic":
        """A topic with the type as we know it."""
        return cls(name, kind, type_hash(kind))

    def key(self, domain: int) -> str:
        """The key of its messages."""
        return f"{domain}/{self.name.strip('/')}/{_dds(self.kind)}/{self.hash}"


def attachment(sequence: int, time_ns: int, gid: bytes) -> bytes:
    """The attachment of a message: number, time of sending, and the publisher's 16 bytes."""
    return struct.pack("<qqB16s", sequence, time_ns, len(gid), gid)


def token(
    kind: str, domain: int, session: str, node: str, entity: int = 0, topic: RosTopic | None = None
) -> str:
    """The key by which an entity announces itself.

    kind: NN a node, MP a publisher, MS a subscription.    node: /namespace/name.
    """
    space, _, name = node.rpartition("/")
    parts = [_SPACE, domain, session, _NODE_ID, entity, kind, "%", _mangled(space or "/"), name]
    if topic is not None:
        parts += [_mangled(topic.name), _dds(topic.kind), topic.hash, _QOS]
    return "/".join(map(str, parts))


def topic_in(key: str) -> RosTopic | None:
    """The topic of an entity's token, or None."""
    parts = key.split("/")
    if len(parts) < 13 or parts[0] != _SPACE:
        return None
    package, _, name = parts[10].partition("::msg::dds_::")
    return RosTopic(
        parts[9].replace("%", "/"), f"{package}/msg/{name.removesuffix('_')}", parts[11]
    )


class Node:
    """A node on a Zenoh session that is open.  It exists as long as it is held, or one
    of its publishers."""

    def __init__(self, session: zenoh.Session, name: str) -> None:
        """name: /namespace/name, or /name."""
        self.session, self.domain, self._name = session, domain_id(), name
        self._zid = str(session.info.zid())
        self._entities = _FIRST_ENTITY
        self._held: list[Any] = []
        self._declare("NN")

    def publisher(self, topic: RosTopic, *, keeps_all: bool = False) -> "Publisher":
        """A publisher.  keeps_all: sending waits for slow readers; else they lose messages."""
        declared = self.session.declare_publisher(
            topic.key(self.domain),
            congestion_control=zenoh.CongestionControl.BLOCK
            if keeps_all
            else zenoh.CongestionControl.DROP,
        )
        return Publisher(self, declared, self._declare("MP", topic))

    def subscribe(self, topic: RosTopic, take: Callable[[bytes], None]) -> Any:
        """Have ``take`` called with the CDR of each message, until what this returns goes.

        Drivers publish only with subscribers, so the subscription is announced in the graph, too.
        """
        subscriber = self.session.declare_subscriber(
            topic.key(self.domain), lambda sample: take(sample.payload.to_bytes())
        )
        self._declare("MS", topic)
        return subscriber

    def published(self) -> list[RosTopic]:
        """All topics with a publisher, by name."""
        found = self.session.liveliness().get(f"{_SPACE}/{self.domain}/*/*/*/MP/**")
        keys = {str(reply.ok.key_expr) for reply in found if reply.ok is not None}
        return sorted(
            {topic for key in keys if (topic := topic_in(key)) is not None},
            key=lambda topic: (topic.name, topic.kind),
        )

    def on_subscription(self, come: Callable[[str], None]) -> None:
        """Have ``come`` called with the name of a topic whenever a subscriber appears."""

        def on_sample(sample: zenoh.Sample) -> None:
            topic = topic_in(str(sample.key_expr))
            if topic is not None and sample.kind == zenoh.SampleKind.PUT:
                come(topic.name)

        self._held.append(
            self.session.liveliness().declare_subscriber(
                f"{_SPACE}/{self.domain}/*/*/*/MS/**", on_sample, history=True
            )
        )

    def _declare(self, kind: str, topic: RosTopic | None = None) -> str:
        entity = _NODE_ID if topic is None else self._entities
        self._entities += topic is not None
        key = token(kind, self.domain, self._zid, self._name, entity, topic)
        self._held.append(self.session.liveliness().declare_token(key))
        return key


class Publisher:
    """Sends messages of one topic."""

    def __init__(self, node: Node, declared: Any, token_key: str) -> None:
        self._node = node
        self._declared = declared
        # rmw_zenoh hashes the token, too (XXH3); readers only compare what messages bring along.
        self._gid = hashlib.blake2b(token_key.encode(), digest_size=16).digest()
        self._sequence = 0

    @property
    def is_heard(self) -> bool:
        """Whether anybody reads."""
        heard: bool = self._declared.matching_status.matching
        return heard

    def put(self, data: bytes) -> None:
        """Send CDR."""
        self._sequence += 1
        self._declared.put(data, attachment=attachment(self._sequence, time.time_ns(), self._gid))


def _mangled(name: str) -> str:
    return name.replace("/", "%")


def _dds(kind: str) -> str:
    """sensor_msgs/msg/Image as DDS has it: sensor_msgs::msg::dds_::Image_."""
    package, _, name = kind.partition("/msg/")
    return f"{package}::msg::dds_::{name}_"
