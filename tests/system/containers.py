"""Images, sessions and volumes of containers, for tests; skips where there is no engine."""

import hashlib
import io
import json
import os
import shutil
import signal
import subprocess
import tarfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import pytest
import yaml

from pliant.bus.session import free_endpoint
from pliant.datasets.builtin import builtin_folder

ROOT = Path(__file__).parents[2]
IMAGE = "pliant-test"
USER = "1000:1000"
TIMEOUT_S = 900
_PACKAGE = Path("/opt/pliant/lib/python3.11/site-packages/pliant")
_CACHE = "/var/cache/pliant"
SOURCE = "built-in:tiny"


def call(
    *command: object, stdin: bytes | None = None, env: Mapping[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(
        [str(part) for part in command],
        input=stdin,
        capture_output=True,
        timeout=TIMEOUT_S,
        env={**os.environ, **(env or {})},
    )
    output, errors = (stream.decode(errors="replace") for stream in (done.stdout, done.stderr))
    return subprocess.CompletedProcess(done.args, done.returncode, output, errors)


def docker(*arguments: object, stdin: bytes | None = None) -> str:
    """Output of a docker command that must not fail."""
    done = call("docker", *arguments, stdin=stdin)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout.strip()


COMPOSES: dict[str, list[str]] = {"1.29": ["docker-compose"], "v2": ["docker", "compose"]}
"""Docker's compose in its two forms."""


def compose_command(form: str) -> list[str]:
    """The command of a form; skips where it is not installed."""
    command = COMPOSES[form]
    installed = shutil.which(command[0]) and call(*command, "version").returncode == 0
    return command if installed else pytest.skip(f"{' '.join(command)} is not installed")


def compose_commands() -> list[list[str]]:
    """Those that are installed."""
    return [
        command
        for command in COMPOSES.values()
        if shutil.which(command[0]) and call(*command, "version").returncode == 0
    ]


def skip_without_engine() -> None:
    if not shutil.which("docker") or call("docker", "info").returncode != 0:
        pytest.skip("no Docker engine answers")
    if not compose_commands():
        pytest.skip("neither docker-compose nor docker compose is installed")
    made = call(ROOT / "scripts" / "base-image")
    if made.returncode != 0:
        pytest.skip(f"no base image: {made.stderr.strip()}")


def build_image() -> None:
    """The services' image, without kernels: those of this machine are given to it.

    Takes the minute or two of installing once; after that only what changed is made again.
    """
    built = call(
        *("docker", "build", "--quiet", "--file", ROOT / "deploy" / "Dockerfile"),
        *("--target", "service", "--build-arg", "KERNELS=", "--tag", IMAGE, ROOT),
        env={"DOCKER_BUILDKIT": "0"},
    )
    if built.returncode != 0 and "apt-get" in built.stderr:
        pytest.skip(f"containers do not reach Debian's packages here: {built.stderr[-500:]}")
    assert built.returncode == 0, built.stdout + built.stderr


def fill_cache(volume: str, source: str) -> None:
    """Put this machine's kernels into a new volume, as Numba looks for them in a container, and
    the rendered source."""
    import pliant

    here = Path(pliant.__file__).parent
    data = io.BytesIO()
    with tarfile.open(fileobj=data, mode="w") as archive:
        for file in sorted([*here.rglob("__pycache__/*.nbi"), *here.rglob("__pycache__/*.nbc")]):
            folder = str(_PACKAGE / file.parents[1].relative_to(here))
            name = f"{Path(folder).name}_{hashlib.sha1(folder.encode()).hexdigest()}"
            archive.add(file, f"kernels/{name}/{file.name}")
        sequence = builtin_folder(source)
        archive.add(sequence, f"sequences/{sequence.name}")
    script = f"tar -C {_CACHE} -xo && chmod -R a+rwX {_CACHE}"
    docker(
        *("run", "--rm", "--interactive", "--user", "0", "--entrypoint", "bash"),
        *("--volume", f"{volume}:{_CACHE}", IMAGE, "-c", script),
        stdin=data.getvalue(),
    )


@dataclass
class Session:
    """A compose project.  files: its compose files.     port: of its router on this machine.
    command: the form of compose that is used; the first one of those that are there, if none.
    """

    name: str
    results: Path
    files: list[Path]
    settings: dict[str, str] = field(default_factory=dict[str, str])
    port: int = field(default_factory=lambda: int(free_endpoint().rsplit(":", 1)[1]))
    command: list[str] = field(default_factory=lambda: compose_commands()[0])

    def compose(self, *arguments: object) -> str:
        """Output of a command of compose that must not fail."""
        done = self.try_compose(*arguments)
        assert done.returncode == 0, done.stdout + done.stderr + self.logs()
        return done.stdout

    def try_compose(self, *arguments: object) -> subprocess.CompletedProcess[str]:
        files = [part for file in self.files for part in ("--file", str(file))]
        command = [*self.command, *files, "--project-name", self.name]
        return call(*command, *arguments, env=self.environment)

    @property
    def environment(self) -> dict[str, str]:
        return {
            "PLIANT_IMAGE": IMAGE,
            "PLIANT_USER": USER,
            "PLIANT_RESULTS": str(self.results),
            "PLIANT_PORT": str(self.port),
            "PLIANT_SOURCE": SOURCE,
            **self.settings,
        }

    def container(self, service: str) -> str:
        """The id of a service's container."""
        labels = {"project": self.name, "service": service}
        filters = [f"--filter=label=com.docker.compose.{k}={v}" for k, v in labels.items()]
        return docker("ps", "--all", "--quiet", *filters)

    def state(self, service: str) -> dict[str, object]:
        """What the engine says of a service's container: Status, Pid, ExitCode ..."""
        return json.loads(docker("inspect", "--format", "{{json .State}}", self.container(service)))

    def kill(self, *services: str) -> None:
        """kill -9 as the kernel does it: ``docker kill`` would keep the engine from restarting.

        A service that has ended while the engine was asked stays so.
        """
        for pid in [int(str(self.state(service)["Pid"])) for service in services]:
            if pid:  # 0: it has ended
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)

    def wait(self, service: str) -> None:
        """Return when a service's container has ended well, after restarts perhaps."""
        container = self.container(service)
        while (state := self.state(service))["Status"] != "exited":
            docker("wait", container)
        assert state["ExitCode"] == 0, self.logs()

    def logs(self) -> str:
        """What all containers of the project have said."""
        mine = f"--filter=label=com.docker.compose.project={self.name}"
        listed = call("docker", "ps", "--all", "--quiet", mine).stdout.split()
        done = [call("docker", "logs", "--tail", "20", each) for each in listed]
        return "".join(each.stdout + each.stderr for each in done)


@contextmanager
def session(
    name: str, results: Path, *files: Path, form: str = "", **settings: str
) -> Iterator[Session]:
    """A compose project whose containers, networks and volumes are gone afterwards."""
    command = compose_command(form) if form else compose_commands()[0]
    results.mkdir(parents=True, exist_ok=True)
    results.chmod(0o777)
    project = Session(name, results, list(files), settings, command=command)
    volume = f"{name}_cache"
    # Version 2 takes a volume for its own by its labels; another one it uses with a warning.
    labels = {"project": name, "volume": "cache"}
    try:
        docker(
            *("volume", "create", volume),
            *(f"--label=com.docker.compose.{key}={value}" for key, value in labels.items()),
        )
        fill_cache(volume, project.environment["PLIANT_SOURCE"])
        yield project
    finally:
        # Version 2 takes down only what the chosen profiles name.
        every = [f"--profile={name}" for name in ("rigid", "deformable", "replay")]
        project.try_compose(*every, "down", "--volumes", "--remove-orphans", "--timeout", "0")
        call("docker", "volume", "rm", "--force", volume)


@contextmanager
def network(name: str, folder: Path) -> Iterator[dict[str, Path]]:
    """A network without a way out that joins machines; yields a compose file for each of them.

    In it the rack's router has the name by which the other machines reach it.
    """
    docker("network", "create", "--internal", name)
    joined: dict[str, Path] = {}
    for machine in ("camera", "edge", "robot", "rack"):
        content: dict[str, object] = {"networks": {"default": {"external": True, "name": name}}}
        if machine == "rack":
            router = {"networks": {"default": {"aliases": ["rack.local"]}}}
            content["services"] = {"router": router}
        joined[machine] = folder / f"{machine}-joined.yaml"
        joined[machine].write_text(yaml.safe_dump(content))
    try:
        yield joined
    finally:
        call("docker", "network", "rm", name)
