"""Hosts on this machine: network namespaces with addresses of their own on one switch.

A cable can be pulled out of the switch and put back.  Skips where the tests may not make them.
"""

import os
import re
import shutil
import signal
import subprocess
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from running import TINY, command, digests

from pliant.bus.health import Health, health_key, read_health
from pliant.bus.session import open_session
from pliant.messages import codec, topics
from pliant.messages.types import Status

SESSION = "lab"
THREE = {"ingest": "camera", "tracking": "edge", "bundle_adjustment": "rack", "recorder": "rack"}
TWO = THREE | {"ingest": "robot", "tracking": "robot"}
"""Who runs where."""
PATIENCE_S = 300.0
_PORT = 7447
_TOOLS = ("ip", "unshare", "hostname")


def _ip(*arguments: str) -> str:
    done = subprocess.run(["ip", *arguments], capture_output=True, text=True)
    if done.returncode != 0:
        raise OSError(f"ip {' '.join(arguments)}: {done.stderr.strip()}")
    return done.stdout


class Hosts:
    """Hosts by name.  ``with``: gone afterwards, with every process in them."""

    def __init__(self, *names: str) -> None:
        self._names = names
        self._prefix = f"pliant-{os.getpid()}"
        self._made: list[str] = []

    def __enter__(self) -> "Hosts":
        try:
            self._make("switch")
            switch = self._space("switch")
            _ip("-n", switch, "link", "add", "name", "switch", "type", "bridge")
            _ip("-n", switch, "link", "set", "dev", "switch", "up")
            for name in self._names:
                self._make(name)
                space = self._space(name)
                _ip("link", "add", "name", "wire", "netns", space, "type", "veth",
                    "peer", "name", name, "netns", switch)  # fmt: skip
                _ip("-n", switch, "link", "set", "dev", name, "master", "switch", "up")
                _ip("-n", space, "addr", "add", f"{self.address(name)}/24", "dev", "wire")
                _ip("-n", space, "link", "set", "dev", "wire", "up")
        except OSError:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        while self._made:
            space = self._made.pop()
            for pid in _ip("netns", "pids", space).split():
                os.kill(int(pid), signal.SIGKILL)
            _ip("netns", "del", space)

    def address(self, name: str) -> str:
        return f"10.77.0.{1 + self._names.index(name)}"

    def command(self, name: str, *command: str) -> list[str]:
        """A command line, to be run on a host; its process is the command itself."""
        on_host = ["ip", "netns", "exec", self._space(name), "unshare", "--uts"]
        return [*on_host, "sh", "-c", 'hostname "$0" && exec "$@"', name, *command]

    def cut(self, name: str) -> None:
        """Pull the host's cable."""
        _ip("-n", self._space("switch"), "link", "set", "dev", name, "down")

    def join(self, name: str) -> None:
        """Put it back."""
        _ip("-n", self._space("switch"), "link", "set", "dev", name, "up")

    def _make(self, name: str) -> None:
        _ip("netns", "add", self._space(name))
        self._made.append(self._space(name))
        _ip("-n", self._space(name), "link", "set", "dev", "lo", "up")

    def _space(self, name: str) -> str:
        return f"{self._prefix}-{name}"


@contextmanager
def hosts(*names: str) -> Iterator[Hosts]:
    """Hosts, or a skip with the reason why there are none."""
    absent = [tool for tool in _TOOLS if shutil.which(tool) is None]
    if absent or os.geteuid() != 0:
        pytest.skip(f"hosts need root and {', '.join(_TOOLS)}")
    with ExitStack() as stack:
        try:
            made = stack.enter_context(Hosts(*names))
        except OSError as error:
            pytest.skip(f"no network namespaces here: {error}")
        yield made


@dataclass
class Spread:
    """A session whose services run on several hosts.  where: the host of each; the router and
    the results are with the recorder.
    """

    hosts: Hosts
    folder: Path
    where: Mapping[str, str]
    source: str = TINY
    settings: str = "bus: {checkpoint_frames: 6, window: 4, link_images: lossless}\n"
    router: "subprocess.Popen[str]" = field(init=False)
    services: dict[str, "subprocess.Popen[str]"] = field(default_factory=dict)

    def __enter__(self) -> "Spread":
        self._changed = threading.Condition()
        self._health: dict[str, Health] = {}
        self._frames: dict[str, int] = {}
        self._routers = 0
        (self.folder / "config.yaml").write_text(self.settings)
        self.start_router()
        return self

    def __exit__(self, *_: object) -> None:
        self._looking.close()
        for process in (*self.services.values(), self.router):
            process.kill()
            process.communicate()

    @property
    def endpoint(self) -> str:
        return f"tcp/{self.hosts.address(self.where['recorder'])}:{_PORT}"

    def start_router(self) -> None:
        """Start it, and look at the session through it."""
        self._routers += 1
        # By a file, for this process is on none of the hosts.
        side = f"unixsock-stream/{self.folder}/router-{self._routers}"
        listen = ["--listen", self.endpoint, "--listen", side]
        self.router = self._start(self.where["recorder"], "router", *listen)
        assert self.router.stdout is not None
        said = self.router.stdout.readline()
        while said.startswith("WARNING"):  # it is open to the other hosts
            said = self.router.stdout.readline()
        assert "router on" in said
        self._looking = open_session([side])
        prefix = f"pliant/{SESSION}"
        self._held = [
            self._looking.declare_subscriber(f"{prefix}/{health_key('*')}", self._on_health),
            self._looking.declare_subscriber(f"{prefix}/{topics.status('*').key}", self._on_status),
        ]

    def restart_router(self) -> None:
        """Kill it, and start it again."""
        self._looking.close()
        self.router.kill()
        self.router.communicate()
        self.start_router()

    def start(self) -> None:
        common = ["--connect", self.endpoint, "--session", SESSION]
        common += ["--config", str(self.folder / "config.yaml")]
        extra = {
            "ingest": ["--source", self.source],
            "recorder": ["--output", str(self.folder / "out" / "recording.mcap"), "--results"],
        }
        for name, host in self.where.items():
            state = ["--state", str(self.folder / f"state-{host}")]
            arguments = ["service", name, *common, *state, *extra.get(name, [])]
            self.services[name] = self._start(host, *arguments)

    def send(self, kind: signal.Signals, service: str) -> None:
        self.services[service].send_signal(kind)

    def _start(self, host: str, *arguments: str) -> "subprocess.Popen[str]":
        return subprocess.Popen(
            self.hosts.command(host, *command(*arguments)),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )

    def status(self) -> str:
        """What ``pliant status`` shows on the router's host."""
        shown = command("status", "--connect", self.endpoint, "--session", SESSION)
        host = self.where["recorder"]
        done = subprocess.run(self.hosts.command(host, *shown), capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done.stdout

    def wait_for_frame(self, service: str, frame: int) -> None:
        """Until a service has told of a frame."""
        self._wait(lambda: self._frames.get(service, -1) >= frame)

    def wait_for_complaint(self, service: str, pattern: str) -> str:
        """Until a service waits for what the pattern says, in its health; returns its words."""
        self._wait(lambda: re.search(pattern, self._waiting_for(service)) is not None)
        return self._waiting_for(service)

    def _waiting_for(self, service: str) -> str:
        return self._health[service].waiting_for if service in self._health else ""

    def _wait(self, met: Callable[[], bool]) -> None:
        with self._changed:
            assert self._changed.wait_for(met, PATIENCE_S), (self._frames, self._health)

    def _on_health(self, sample) -> None:
        found = read_health(sample)
        assert found is not None
        with self._changed:
            self._health[found[1].service] = found[1]
            self._changed.notify_all()

    def _on_status(self, sample) -> None:
        if sample.attachment.to_bytes()[-1:] == b"\0":
            status = codec.decode(Status, sample.payload.to_bytes())
            with self._changed:
                self._frames[status.service] = status.frame
                self._changed.notify_all()

    def results(self) -> dict[str, str]:
        """Digests of the result files, when everybody has left in good order."""
        said = {name: p.communicate(timeout=PATIENCE_S)[0] for name, p in self.services.items()}
        codes = {name: process.returncode for name, process in self.services.items()}
        assert codes == dict.fromkeys(self.services, 0), said
        return digests(self.folder / "out")
