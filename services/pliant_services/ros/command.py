"""Behind ``pliant ros``: a viewer of a running session that publishes it to ROS 2.

It sees what viewers see (``runtime/relay.py``), and nothing waits for it.
"""

import re
from dataclasses import dataclass

from pliant.bus.session import Identity, open_session
from pliant.errors import ResultError
from pliant.ros.graph import Node
from pliant.viewers.ros import RosCanvas
from pliant_services.view.command import follow

_NAME = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")


@dataclass(frozen=True, kw_only=True)
class RosRequest:
    """Which session is published, and where.

    endpoints, session, identity: of Pliant.    router: of rmw_zenoh.    name: what topics begin
    with, and the node's name, such as /pliant.    patience_s: for a session that is to start.
    """

    endpoints: list[str]
    session: str
    identity: Identity | None
    router: str
    name: str
    patience_s: float = 0.0


def run_ros(request: RosRequest) -> None:
    """Publish until the session ends.  Raises PliantError."""
    if not _NAME.fullmatch(request.name):
        raise ResultError(f"--name {request.name}: not a name that ROS accepts, such as /pliant")
    if not request.session:
        raise ResultError("--connect needs --session: `pliant status` lists the sessions")
    with open_session([request.router]) as ros:
        canvas = RosCanvas(Node(ros, request.name), request.name)
        follow(request.endpoints, request.session, canvas, request.patience_s, request.identity)
