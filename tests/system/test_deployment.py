"""The files in deploy/: what users start sessions with, in containers."""

import os
import shutil
import threading
import uuid
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
import yaml
from containers import (
    COMPOSES,
    IMAGE,
    ROOT,
    SOURCE,
    USER,
    Session,
    build_image,
    call,
    compose_commands,
    docker,
    network,
    session,
    skip_without_engine,
)
from running import FILES, pliant

from pliant.bus.session import open_session
from pliant.config import config_yaml, load_config
from pliant.messages import codec, topics
from pliant.messages.types import Status
from pliant.recording.reader import Recording
from pliant_services.profiles import PROFILES

pytestmark = pytest.mark.system

DEPLOY = ROOT / "deploy"

only_in_soak = pytest.mark.skipif(
    "PLIANT_SOAK" not in os.environ, reason="takes minutes: scripts/soak runs it"
)
SERVICES_OF = {
    "camera": ["ingest"],
    "edge": ["tracking"],
    "robot": ["ingest", "tracking"],
    "rack": ["router", "bundle_adjustment", "recorder"],
}


def results_of(folder: Path) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in FILES}


@pytest.fixture(scope="module")
def on_the_host(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The results of the same run without containers."""
    output = tmp_path_factory.mktemp("host")
    done = pliant("run", SOURCE, "--output", output, "--force", "--set", "meshing.enabled=false")
    assert done.returncode == 0, done.stderr
    return results_of(output)


@pytest.fixture(scope="module")
def image() -> None:
    skip_without_engine()
    build_image()


@pytest.mark.parametrize("profile", ["rigid", "deformable", "replay"])
def test_every_compose_on_this_machine_reads_the_file(profile: str) -> None:
    if not compose_commands():
        pytest.skip("neither docker-compose nor docker compose is installed")
    for command in compose_commands():
        done = call(
            *command, "--file", DEPLOY / "compose.yaml", "--profile", profile, "config",
        )  # fmt: skip
        assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("profile", ["rigid", "deformable"])
def test_a_profile_starts_its_services_and_each_knows_the_others(profile: str) -> None:
    content = yaml.safe_load((DEPLOY / "compose.yaml").read_text())
    mine = [s for s in content["services"].values() if profile in s.get("profiles", [])]
    told = {part for s in mine for part in s["command"] if part.startswith("--profile=")}
    # The mesh is made when the session is over: a mesher cannot go on where it was.
    session = "points" if profile == "rigid" else profile
    assert told == {f"--profile={session}"}
    services = {s["command"][1] for s in mine if s["command"][0] == "service"}
    assert services == set(PROFILES[session])


def test_nothing_runs_as_root_or_writes_into_its_image() -> None:
    content = yaml.safe_load((DEPLOY / "compose.yaml").read_text())
    for name, service in content["services"].items():
        assert service["read_only"], name
        assert service["cap_drop"] == ["ALL"], name
        assert not str(service["user"]).startswith("0"), name
        assert all(port.startswith("127.0.0.1:") for port in service.get("ports", [])), name


@pytest.mark.parametrize("unit", ["pliant-router.service", "pliant@.service"])
def test_systemd_takes_the_units(unit: str, tmp_path: Path) -> None:
    if not shutil.which("systemd-analyze"):
        pytest.skip("systemd-analyze is not installed")
    text = (DEPLOY / "systemd" / unit).read_text()
    assert "/opt/pliant/bin/pliant " in text
    copy = tmp_path / unit.replace("@", "@tracking")
    copy.write_text(text.replace("/opt/pliant/bin/pliant ", "/bin/true "))
    done = call("systemd-analyze", "verify", copy)
    assert (done.returncode, done.stderr) == (0, "")
    done = call("systemd-analyze", "security", "--offline=true", "--threshold=35", copy)
    assert done.returncode == 0, done.stdout  # exposed by 3.5 of 10 at most


@pytest.mark.parametrize("command", ["service", "router"])
def test_options_in_systemd_units_exist(command: str) -> None:
    known = pliant(command, "--help", env={"COLUMNS": "200"}).stdout
    files = ["router.env"] if command == "router" else ["session.env", "ingest.env", "recorder.env"]
    for file in files:
        words = (DEPLOY / "systemd" / file).read_text().split()
        options = [w.rpartition("=")[2] for w in words if "--" in w and w != "--connect"]
        assert options, file
        assert [option for option in options if f"{option} " not in known] == [], file


class Followed:
    """Listens to a session's status from outside, as a viewer would."""

    def __init__(self, port: int, name: str) -> None:
        self._changed = threading.Condition()
        self._frames: dict[str, int] = {}
        self._session = open_session([f"tcp/127.0.0.1:{port}"])
        self._held = self._session.declare_subscriber(
            f"pliant/{name}/{topics.status('*').key}", self._on_sample
        )

    def _on_sample(self, sample) -> None:
        envelope = sample.attachment.to_bytes()
        if envelope[-1:] == b"\0":
            status = codec.decode(Status, sample.payload.to_bytes())
            with self._changed:
                self._frames[status.service] = status.frame
                self._changed.notify_all()

    def wait_for(self, service: str, frame: int) -> None:
        with self._changed:
            assert self._changed.wait_for(lambda: self._frames.get(service, -1) >= frame, 300)

    def close(self) -> None:
        self._session.close()


class Heard:
    """What is published under a key of a session, as a viewer would hear it."""

    def __init__(self, port: int, name: str, key: str) -> None:
        self._changed = threading.Condition()
        self._payloads: set[bytes] = set()
        self._session = open_session([f"tcp/127.0.0.1:{port}"])
        self._held = self._session.declare_subscriber(f"pliant/{name}/{key}", self._on_sample)

    def _on_sample(self, sample) -> None:
        with self._changed:
            self._payloads.add(sample.payload.to_bytes())
            self._changed.notify_all()

    def wait_for(self, payloads: set[bytes]) -> None:
        with self._changed:
            assert self._changed.wait_for(lambda: self._payloads >= payloads, 120)

    def __enter__(self) -> "Heard":
        return self

    def __exit__(self, *_: object) -> None:
        self._session.close()


@pytest.mark.parametrize("machine", ["camera", "edge", "robot", "rack"])
def test_every_compose_reads_the_files_of_the_machines(machine: str) -> None:
    if not compose_commands():
        pytest.skip("neither docker-compose nor docker compose is installed")
    for command in compose_commands():
        done = call(*command, "--file", DEPLOY / "machines" / f"{machine}.yaml", "config")
        assert done.returncode == 0, done.stderr
        content = yaml.safe_load(done.stdout)
        for name, service in content["services"].items():
            assert service["read_only"], name
            own = set() if name == "mesher" else {"ca.pem", f"{name}.key", f"{name}.pem"}
            assert {secret["source"] for secret in service.get("secrets", [])} == own
            assert "certs" not in str(service["volumes"])
            assert not own or any(part.startswith("--tls") for part in service["command"])


@contextmanager
def workstation(
    folder: Path, form: str, settings: Sequence[str] = (), source: str = SOURCE
) -> Iterator[Session]:
    """A session of the compose file, with parameters."""
    config = folder / "config.yaml"
    config.write_text(config_yaml(load_config(overrides=[*settings])))
    with session(
        f"pliant-test-{uuid.uuid4().hex[:8]}",
        folder / "results",
        DEPLOY / "compose.yaml",
        form=form,
        PLIANT_CONFIG=str(config),
        PLIANT_SOURCE=source,
    ) as one:
        yield one


@pytest.mark.docker
@pytest.mark.slow
@pytest.mark.parametrize("form", list(COMPOSES))
def test_killed_containers_come_back_and_the_results_are_those_of_the_host(
    image: None, form: str, tmp_path: Path, on_the_host: dict[str, bytes]
) -> None:
    with workstation(tmp_path, form, ["bus.checkpoint_frames=6"]) as running:
        running.compose("up", "--detach", "router", *PROFILES["points"])
        followed = Followed(running.port, "session")
        followed.wait_for("bundle_adjustment", 8)
        running.kill("tracking", "recorder")
        followed.wait_for("bundle_adjustment", 25)
        running.kill("bundle_adjustment")
        running.wait("router")
        followed.close()
        for service in PROFILES["points"]:
            running.wait(service)
    folder = tmp_path / "results" / "session"
    assert results_of(folder) == on_the_host
    assert pliant("info", folder).returncode == 0


@pytest.mark.docker
@pytest.mark.slow
@pytest.mark.parametrize("form", list(COMPOSES))
def test_surfels_in_containers_are_those_of_the_host_and_are_replayed(
    image: None, form: str, tmp_path: Path
) -> None:
    """The profile deformable, then replay on what it recorded."""
    source, few = f"{SOURCE}?frames=4", ["surfels.max_surfels=60"]
    here = tmp_path / "host"
    sets = [word for each in few for word in ("--set", each)]
    done = pliant("run", source, "--profile", "deformable", "--output", here, *sets)
    assert done.returncode == 0, done.stderr
    with workstation(tmp_path, form, few, source) as running:
        running.compose("--profile", "deformable", "up", "--detach")
        for service in ("router", "source-of-surfels", "surfels", "recorder-of-surfels"):
            running.wait(service)
        there = running.results / "session"
        name = "trajectory.txt"
        assert (there / name).read_bytes() == (here / name).read_bytes()
        # Not surfels.npz: another release of Python writes other zip headers round the arrays.
        wanted = [m.data for m in Recording(here).messages(topics.SURFELS)]
        assert [m.data for m in Recording(there).messages(topics.SURFELS)] == wanted
        assert len(wanted) == 4
        running.compose("--profile", "replay", "up", "--detach")
        with Heard(running.port, "replay", topics.SURFELS.key) as heard:
            heard.wait_for(set(wanted))


@pytest.mark.docker
@pytest.mark.slow
@only_in_soak
@pytest.mark.parametrize("form", list(COMPOSES))
def test_the_one_command_builds_both_images_and_ends_with_results_and_mesh(
    image: None, form: str, tmp_path: Path
) -> None:
    """``up --build``, and ``start`` after a ``docker kill``."""
    here = tmp_path / "host"
    assert pliant("run", SOURCE, "--output", here).returncode == 0
    name = f"pliant-test-{uuid.uuid4().hex[:8]}"
    compose = DEPLOY / "compose.yaml"
    with session(name, tmp_path / "results", compose, form=form, PLIANT_IMAGE=name) as running:
        running.compose("up", "--build", "--detach")
        followed = Followed(running.port, "session")
        followed.wait_for("bundle_adjustment", 8)
        running.compose("kill", "tracking")
        running.compose("start", "tracking")
        followed.close()
        for service in ("router", *PROFILES["points"], "mesher"):
            running.wait(service)
        there = running.results / "session"
        assert results_of(there) == results_of(here)
        for mesh in ("mesh.ply", "mesh_coarse.ply"):
            made = running.results / "session_mesh" / mesh
            assert made.read_bytes() == (here / mesh).read_bytes()


@pytest.mark.docker
@pytest.mark.slow
@pytest.mark.parametrize(
    "machines",
    [
        pytest.param(("robot", "rack"), marks=only_in_soak, id="two"),
        pytest.param(("camera", "edge", "rack"), id="three"),
    ],
)
def test_several_machines_over_tls_give_the_results_of_one(
    image: None, machines: tuple[str, ...], tmp_path: Path, on_the_host: dict[str, bytes]
) -> None:
    here = tmp_path / "here"
    here.mkdir()
    here.chmod(0o777)  # the tests run as one user, the containers as another
    certs = ["certs", "/here/certs", "--host", "rack.local"]
    docker("run", "--rm", "--user", USER, "-v", f"{here}:/here", IMAGE, *certs)
    name = f"pliant-test-{uuid.uuid4().hex[:8]}"
    with network(name, tmp_path) as joined, ExitStack() as running:
        sessions: dict[str, Session] = {}
        for machine in reversed(machines):  # in any order; results are the last machine's
            sessions[machine] = running.enter_context(
                session(
                    f"{name}-{machine}",
                    tmp_path / "results",
                    DEPLOY / "machines" / f"{machine}.yaml",
                    joined[machine],
                    PLIANT_CERTS=str(here / "certs"),
                    PLIANT_PORT="7447",  # what the router listens on in there
                    PLIANT_LISTEN="127.0.0.1",
                )
            )
            sessions[machine].compose("up", "--detach", *SERVICES_OF[machine])
        sessions["rack"].wait("router")
        for machine, started in sessions.items():
            for service in SERVICES_OF[machine]:
                started.wait(service)
    assert results_of(tmp_path / "results" / "session") == on_the_host
