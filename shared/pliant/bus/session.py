"""Zenoh sessions as Pliant uses them: explicit endpoints, nothing found by scouting."""

import fcntl
import json
import os
import re
import reprlib
import shutil
import socket
import stat
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from ipaddress import ip_address
from pathlib import Path
from typing import Any

import zenoh

from pliant.errors import BusError
from pliant.messages.topics import TOPICS

CONNECT_TIMEOUT_S = 7.0  # with the start of Python, a user waits ten seconds at most
_PATIENCE_MS = 60_000  # Zenoh's defaults lose messages after a stall of 5 to 10 s (its second line)
_BATCHES = 16
"""Length of each transmission queue, in batches of 64 KiB: Zenoh's maximum, to hold an image."""
_ROUTER_DROPS_US, _SENDER_DROPS_US = 20_000, 1_000_000
"""How long a full queue may delay a droppable message: in the router, and in a sender, which must
wait for the router.  Zenoh waits 50 ms longer for the batches after the first.
"""
TOKEN_LEASE_S = 5.0 + 1e-3 * _PATIENCE_MS
"""Seconds after which the router drops a service whose machine has vanished."""
_LONGEST_SOCKET = 100  # bytes; Linux takes 107 and macOS 103
_SOCKET = "unixsock-stream"
_FOLDER, _BUS = "pliant-", "bus"
_NO_SOCKET = "no Unix socket available: every user of this machine can reach the services"
_MAX_BYTES = max(topic.max_bytes for topic in TOPICS) + (1 << 20)
"""A peer that announces more than our largest topic is cut off, before memory is allocated."""


_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")


def is_session_name(name: str) -> bool:
    """Whether a name can be a session's: one part of a key, which matches nothing but itself."""
    return _NAME.fullmatch(name) is not None


def session_name(name: str) -> str:
    """The name of a session.  Raises BusError for anything else."""
    if not is_session_name(name):
        raise BusError(
            f"--session {reprlib.repr(name)}: use letters, digits, '_', '-' and '.', 64 at most, "
            "and begin with a letter or a digit"
        )
    return name


@dataclass(frozen=True)
class Identity:
    """A peer's certificate and key, and the authority that vouches for all of them (PEM files)."""

    authority: Path
    certificate: Path
    key: Path

    @classmethod
    def in_folder(cls, folder: Path, name: str) -> "Identity":
        """The identity ``name`` in a folder that ``pliant certs`` made.

        Raises BusError if it is not there.
        """
        own = cls(folder / "ca.pem", folder / f"{name}.pem", folder / f"{name}.key")
        for path in (own.authority, own.certificate, own.key):
            if not path.is_file():
                raise BusError(
                    f"{path}: no such certificate: make one with `pliant certs {folder}`"
                )
        return own


def _config(mode: str, identity: Identity | None) -> zenoh.Config:
    config = zenoh.Config()
    # Beyond what a process may lock, 8 MiB for most users, Zenoh drops messages in shared memory
    # without a word (its issues 2787 and 2788); below that a run takes no less CPU.
    config.insert_json5("transport/shared_memory/enabled", "false")
    config.insert_json5("mode", json.dumps(mode))
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("scouting/gossip/enabled", "false")
    config.insert_json5(
        "scouting/delay", "0"
    )  # a router waits so long for others, of half a second
    config.insert_json5("transport/link/rx/max_message_size", str(_MAX_BYTES))
    config.insert_json5("transport/link/tx/lease", str(_PATIENCE_MS))
    config.insert_json5(
        "transport/link/tx/queue/congestion_control/block/wait_before_close",
        str(_PATIENCE_MS * 1000),
    )
    for queue in ("data", "data_high"):
        config.insert_json5(f"transport/link/tx/queue/size/{queue}", str(_BATCHES))
    drops_us = _ROUTER_DROPS_US if mode == "router" else _SENDER_DROPS_US
    config.insert_json5(
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop", str(drops_us)
    )
    if identity is not None:
        side = "listen" if mode == "router" else "connect"
        tls = {
            "root_ca_certificate": str(identity.authority),
            "enable_mtls": True,
            f"{side}_certificate": str(identity.certificate),
            f"{side}_private_key": str(identity.key),
            "verify_name_on_connect": True,
        }
        config.insert_json5("transport/link/tls", json.dumps(tls))
    return config


def open_session(endpoints: Sequence[str], identity: Identity | None = None) -> zenoh.Session:
    """Connect as a client.  ``identity``: for endpoints such as tls/host:7447.

    Raises BusError when no endpoint answers in time.
    """
    config = _config("client", identity)
    _set_endpoints(config, "connect", endpoints)
    config.insert_json5("connect/timeout_ms", str(int(CONNECT_TIMEOUT_S * 1000)))
    config.insert_json5("connect/exit_on_failure", "true")
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise BusError(
            f"cannot reach {', '.join(endpoints)} within {CONNECT_TIMEOUT_S:.0f} s: is the router "
            f"running there? ({_first_line(error)})"
        ) from None


def open_router(
    *endpoints: str,
    identity: Identity | None = None,
    access_control: Mapping[str, Any] | None = None,
) -> zenoh.Session:
    """Listen as a router.  ``access_control``: Zenoh's, by the names in certificates.

    Raises BusError when an endpoint is taken or is not one.
    """
    config = _config("router", identity)
    if access_control is not None:
        config.insert_json5("access_control", json.dumps(access_control))
    _set_endpoints(config, "listen", endpoints)
    config.insert_json5("listen/exit_on_failure", "true")
    config.insert_json5("listen/timeout_ms", "0")
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise BusError(
            f"cannot listen on {', '.join(endpoints)}: is the port in use? Choose another with "
            f"--port ({_first_line(error)})"
        ) from None


def _set_endpoints(config: zenoh.Config, what: str, endpoints: Sequence[str]) -> None:
    try:
        config.insert_json5(f"{what}/endpoints", json.dumps(list(endpoints)))
    except zenoh.ZError:
        raise BusError(
            f"{', '.join(endpoints)}: not an endpoint; write it like tcp/127.0.0.1:7447"
        ) from None


class LocalRouter:
    """A router for the processes of one user: at a Unix socket in a folder of its own.

    On a loopback port, which every user of the machine reaches, where one is given or no such
    socket can be had: ``note`` then has the reason, otherwise "".
    """

    def __init__(self, port: int | None = None) -> None:
        """Raises BusError when the port is in use."""
        self.note = ""
        self._folder = ""
        if port is None:
            self._folder, self.endpoint, self.note = _socket_folder()
        else:
            self.endpoint = f"tcp/127.0.0.1:{port}"
        try:
            self.session = open_router(self.endpoint)
        except BusError as error:
            if not self._folder:
                raise
            self.endpoint, self.note = free_endpoint(), f"{_NO_SOCKET} ({error})"
            self.session = open_router(self.endpoint)

    def close(self) -> None:
        """Close the session.  Raises ZError if a client does not answer."""
        try:
            self.session.close()  # type: ignore[no-untyped-call]
        finally:
            if self._folder:
                shutil.rmtree(self._folder, ignore_errors=True)


def _clear_left(temporary: Path) -> None:
    """Remove the folders of killed routers: their locks are free, or nothing listens."""
    for folder in temporary.glob(f"{_FOLDER}*"):
        with suppress(OSError):
            names = {path.name for path in folder.iterdir()}
            found = folder.lstat()
            ours = stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid()
            if not ours or names != {_BUS, f"{_BUS}.lock"}:
                continue
            flags = os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC
            lock = os.open(folder / f"{_BUS}.lock", flags)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if not _listens(folder / _BUS):
                    shutil.rmtree(folder)
            finally:
                os.close(lock)


def _listens(path: Path) -> bool:
    """Whether a process listens at a Unix socket.  Raises OSError if that is unknown."""
    with socket.socket(socket.AF_UNIX) as probe:
        probe.setblocking(False)
        try:
            probe.connect(str(path))
        except ConnectionRefusedError:
            return False
    return True


def _socket_folder() -> tuple[str, str, str]:
    """A new folder that only its owner may enter, the endpoint in it, and why there is none."""
    try:
        _clear_left(Path(tempfile.gettempdir()))
        folder = tempfile.mkdtemp(prefix=_FOLDER)
    except OSError as error:
        return "", free_endpoint(), f"{_NO_SOCKET} ({error.strerror})"
    path = f"{folder}/{_BUS}"
    if len(os.fsencode(path)) > _LONGEST_SOCKET:
        os.rmdir(folder)
        return "", free_endpoint(), f"{_NO_SOCKET} ({path} is too long: set TMPDIR)"
    return folder, f"{_SOCKET}/{path}", ""


def free_endpoint() -> str:
    """A loopback endpoint on a port that is free now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def is_socket(endpoint: str) -> bool:
    """Whether only processes of one user on this machine meet there, as those of a run do."""
    return endpoint.startswith(f"{_SOCKET}/")


def is_beyond_loopback(endpoint: str) -> bool:
    """Whether the text of a listening endpoint allows connections from other machines."""
    protocol, _, address = endpoint.partition("/")
    if protocol.startswith("unix"):
        return False
    host = address.partition("#")[0].rpartition(":")[0].strip("[]")
    try:
        return not ip_address(host).is_loopback
    except ValueError:
        return host != "localhost"


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [""])[0].split(" at /")[0][:200]
