"""Certificates and access control over real TLS links on loopback."""

import ctypes
import itertools
import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from functools import partial
from pathlib import Path

import pytest
from running import command

pytest.importorskip("cryptography")

from cryptography.x509 import ExtendedKeyUsage, SubjectAlternativeName, load_pem_x509_certificate
from cryptography.x509.oid import ExtendedKeyUsageOID

from pliant.bus import session
from pliant.bus.session import (
    Identity,
    free_endpoint,
    is_beyond_loopback,
    open_router,
    open_session,
)
from pliant.errors import BusError, ResultError
from pliant.messages import topics
from pliant.recording.reader import Recording
from pliant_services.runtime import relay
from pliant_services.runtime.relay import Relays
from pliant_services.security.access import NAMES, OPERATOR, access_control, may_write
from pliant_services.security.certificates import ROUTER, make_certificates

PATIENCE_S = 20.0


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("certs")
    make_certificates(made, NAMES, ["localhost", "127.0.0.1"])
    return made


@pytest.fixture(scope="module")
def endpoint(folder: Path) -> Iterator[str]:
    found = free_endpoint().replace("tcp/", "tls/")
    identity = Identity.in_folder(folder, "router")
    router = open_router(found, identity=identity, access_control=access_control())
    yield found
    router.close()


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Who is refused tries again until the time is over, which says no more after seven seconds."""
    monkeypatch.setattr(session, "CONNECT_TIMEOUT_S", 1.0)


def test_made_once_and_keys_are_secret(folder: Path) -> None:
    before = (folder / "tracking.key").read_bytes()
    assert make_certificates(folder, NAMES, []) == []
    assert (folder / "tracking.key").read_bytes() == before
    assert (folder / "tracking.key").stat().st_mode & 0o077 == 0


def test_only_a_folder_that_is_not_mounted_has_the_signing_key(folder: Path) -> None:
    assert not (folder / "ca.key").exists()
    key = folder.with_name(f"{folder.name}-authority") / "ca.key"
    assert key.stat().st_mode & 0o077 == key.parent.stat().st_mode & 0o077 == 0
    with pytest.raises(ResultError, match="choose an --authority outside of it"):
        make_certificates(folder, NAMES, [], authority=folder / "authority")


def test_an_authority_that_is_elsewhere_is_requested(folder: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    (copy / "operator.key").unlink()
    with pytest.raises(ResultError, match="--authority"):
        make_certificates(copy, NAMES, [])
    authority = folder.with_name(f"{folder.name}-authority")
    assert make_certificates(copy, NAMES, [], authority=authority) == ["operator"]
    (copy / "ca.key").write_bytes((authority / "ca.key").read_bytes())  # as it was until 0.1
    with pytest.raises(ResultError, match="in another folder"):
        make_certificates(copy, NAMES, [], authority=authority)


@pytest.mark.usefixtures("impatient")
def test_no_other_certificate_plays_the_router(folder: Path) -> None:
    found = free_endpoint().replace("tcp/", "tls/")
    with (
        closing(open_router(found, identity=Identity.in_folder(folder, OPERATOR))),
        pytest.raises(BusError, match="cannot reach"),
    ):
        open_session([found], Identity.in_folder(folder, "ingest"))


def test_only_the_routers_certificate_proves_a_server(folder: Path) -> None:
    for name in NAMES:
        certificate = load_pem_x509_certificate((folder / f"{name}.pem").read_bytes())
        usages = certificate.extensions.get_extension_for_class(ExtendedKeyUsage).value
        assert (ExtendedKeyUsageOID.SERVER_AUTH in usages) == (name == ROUTER)
        kinds = [type(extension.value) for extension in certificate.extensions]
        assert (SubjectAlternativeName in kinds) == (name == ROUTER)


@pytest.mark.parametrize("host", ["0.0.0.0", "127.0.0.1"])
def test_a_router_on_a_public_address_warns(host: str) -> None:
    endpoint = free_endpoint().replace("127.0.0.1", host)
    router = subprocess.Popen(
        command("router", "--listen", endpoint),
        stderr=subprocess.PIPE,
        text=True,
    )
    with router:
        assert router.stderr is not None
        said = list(itertools.takewhile(lambda line: "router on" not in line, router.stderr))
        router.terminate()
    warned = [line for line in said if "WARNING" in line and "pliant certs" in line]
    assert len(warned) == (host == "0.0.0.0")


@pytest.mark.skipif(sys.platform != "linux", reason="threads in /proc")
def test_a_signal_that_another_thread_receives_ends_a_router() -> None:
    router = subprocess.Popen(
        command("router", "--listen", free_endpoint()), stderr=subprocess.PIPE, text=True
    )
    with router:
        assert router.stderr is not None
        assert any("router on" in line for line in router.stderr)
        state = Path(f"/proc/{router.pid}/stat")
        while state.read_text().rpartition(") ")[2].startswith("R"):
            pass  # it is about to wait
        threads = sorted(int(name) for name in os.listdir(f"/proc/{router.pid}/task"))
        assert ctypes.CDLL(None).tgkill(router.pid, threads[1], signal.SIGTERM) == 0
        try:
            assert router.wait(timeout=60.0) == 0
        finally:
            router.kill()


def test_which_endpoints_other_machines_reach() -> None:
    assert not any(
        map(is_beyond_loopback, ["tcp/localhost:1", "tcp/[::1]:1", "unixsock-stream//run/pliant"])
    )
    assert all(
        map(is_beyond_loopback, ["tcp/[::]:1", "udp/10.0.0.2:1", "tcp/rack.local:1#iface=a"])
    )


@pytest.mark.usefixtures("impatient")
def test_without_a_certificate_there_is_no_access(endpoint: str) -> None:
    with pytest.raises(BusError, match="cannot reach"):
        open_session([endpoint])


@pytest.mark.usefixtures("impatient")
def test_a_certificate_of_another_authority_is_refused(endpoint: str, tmp_path: Path) -> None:
    make_certificates(tmp_path / "theirs", ["tracking"], [])
    with pytest.raises(BusError, match="cannot reach"):
        open_session([endpoint], Identity.in_folder(tmp_path / "theirs", "tracking"))


def test_a_service_publishes_its_own_topics_and_no_other(endpoint: str, folder: Path) -> None:
    came: list[str] = []
    changed = threading.Condition()

    def on_sample(sample) -> None:
        with changed:
            came.append(str(sample.key_expr))
            changed.notify_all()

    with (
        open_session([endpoint], Identity.in_folder(folder, OPERATOR)) as reader,
        open_session([endpoint], Identity.in_folder(folder, "tracking")) as tracking,
    ):
        reader.declare_subscriber("pliant/**", on_sample)
        # The last one is allowed and comes over the same link, behind those that are not.
        for key in ("camera/image", "map/update", "credit/tracks/extrema/recorder", "control/stop"):
            tracking.put(f"pliant/s/{key}", b"forged")
        with changed:
            while "pliant/s/tracks/extrema" not in came:  # until the subscription has reached it
                tracking.put("pliant/s/tracks/extrema", b"own")
                changed.wait(0.2)
    assert set(came) == {"pliant/s/tracks/extrema"}


def test_certificates_of_a_session_are_good_for_no_other(tmp_path: Path) -> None:
    authority = tmp_path / "authority"
    for name in ("lab", "yard"):
        make_certificates(tmp_path / name, NAMES, ["127.0.0.1"], authority=authority, session=name)
    with pytest.raises(ResultError, match=r"not of operator\.yard"):
        make_certificates(tmp_path / "lab", NAMES, [], authority=authority, session="yard")
    found = free_endpoint().replace("tcp/", "tls/")
    lab, yard = (
        {service: Identity.in_folder(tmp_path / name, service) for service in NAMES}
        for name in ("lab", "yard")
    )
    served = access_control(["lab", "yard"])
    heard: dict[str, list[str]] = {"lab": [], "yard": []}
    changed = threading.Condition()

    def hear(where: str, sample) -> None:
        with changed:
            heard[where].append(str(sample.key_expr))
            changed.notify_all()

    with (
        closing(open_router(found, identity=lab["router"], access_control=served)),
        open_session([found], lab[OPERATOR]) as in_lab,
        open_session([found], yard[OPERATOR]) as in_yard,
        open_session([found], lab["tracking"]) as tracking,
    ):
        in_lab.declare_subscriber("pliant/**", partial(hear, "lab"))
        in_lab.declare_subscriber("pliant/lab/**", partial(hear, "lab"))
        in_yard.declare_subscriber("pliant/yard/**", partial(hear, "yard"))
        with changed:
            while not heard["lab"]:  # over one link: what is not allowed would have come before
                for name in ("yard", "lab"):
                    tracking.put(f"pliant/{name}/tracks/extrema", b"tracks")
                changed.wait(0.2)
    assert set(heard["lab"]) == {"pliant/lab/tracks/extrema"}
    assert heard["yard"] == []


def test_everybody_in_the_list_of_processes_may_write_something() -> None:
    assert all(may_write(name) for name in NAMES[1:])
    assert "pliant/*/camera/image" in may_write("ingest")
    assert "pliant/*/camera/image" not in may_write("tracking")


def test_a_folder_without_the_certificate_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(BusError, match="pliant certs"):
        Identity.in_folder(tmp_path, "tracking")


def test_what_strangers_announce_costs_no_threads_and_few_sessions_are_relayed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(relay, "_MOST_VIEWED", 3)
    monkeypatch.setattr(relay, "_MOST_SESSIONS", 150)
    found = free_endpoint()
    router = open_router(found)
    relays, names = Relays(router), [f"s{number}" for number in range(200)]

    def until(holds: Callable[[], bool]) -> None:
        with relays._changed:
            assert relays._changed.wait_for(holds, PATIENCE_S)

    with closing(router), closing(relays), open_session([found]) as stranger:
        tokens = stranger.liveliness()
        before = _threads()
        held = [tokens.declare_token(f"pliant/{name}/ready/x/1/2/3") for name in ("a b", *names)]
        until(lambda: len(relays._tokens) == 150)
        assert relays._tokens.keys() <= {*names}
        assert _threads() == before
        held += [tokens.declare_token(f"pliant/{name}/viewer/1") for name in names]
        until(lambda: len(relays._relays) == 3 and len(relays._viewers) == 150)
        held.clear()
        until(lambda: not relays._relays and not relays._tokens)


def _threads() -> int:
    """Of this process, those of libraries included."""
    return len(list(Path("/proc/self/task").iterdir()))


def test_a_viewer_sees_a_session_through_the_router_and_a_late_one_its_camera(folder: Path) -> None:
    found = free_endpoint().replace("tcp/", "tls/")
    router = open_router(
        found,
        identity=Identity.in_folder(folder, "router"),
        access_control=access_control(),
    )
    relays = Relays(router)
    recording = Path(__file__).parents[1] / "data" / "reference" / "reference.mcap"
    camera = next(Recording(recording).messages(topics.STREAM)).data
    came: list[bytes] = []
    changed = threading.Condition()

    def on_sample(sample) -> None:
        with changed:
            came.append(sample.payload.to_bytes())
            changed.notify_all()

    with (
        closing(router),
        closing(relays),
        open_session([found], Identity.in_folder(folder, "ingest")) as ingest,
        open_session([found], Identity.in_folder(folder, OPERATOR)) as viewer,
    ):
        token = ingest.liveliness().declare_token("pliant/s/ready/ingest/1/2/0.1.0")
        for payload in (b"no camera", camera):
            ingest.put("pliant/s/camera/stream", payload, attachment=bytes(17))
        held = [
            viewer.declare_subscriber("pliant/s/view/**", on_sample),
            viewer.liveliness().declare_token("pliant/s/viewer/1"),
        ]
        with changed:
            assert changed.wait_for(lambda: camera in came, PATIENCE_S)
        held.clear()
        token.undeclare()
    assert b"no camera" not in came
