"""`pliant view` and `pliant run --save`, on a machine without a display."""

import itertools
import signal
import socket
import subprocess
import sys
from pathlib import Path
from typing import cast
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import numpy as np
import pytest
from benchmarks.viewer_cost import run_with
from running import COARSE_MESH, NO_MESH, TINY, command, in_this_process, pliant

from pliant.bus.session import free_endpoint
from pliant.datasets.source_spec import SourceSpec
from pliant.errors import ResultError
from pliant.viewers import rerun, rerun_data
from pliant.viewers.rerun import RerunCanvas
from pliant.viewers.rerun_data import RerunData
from pliant.viewers.rerun_program import RerunProgram, listens
from pliant_services.run import spectators
from pliant_services.run.command import RunRequest, run_pipeline
from pliant_services.run.spectators import check_viewer
from pliant_services.runtime.launcher import Fleet

pytestmark = pytest.mark.system


@pytest.mark.slow
def test_a_run_is_shown_live_and_afterwards(tmp_path: Path) -> None:
    rr = pytest.importorskip("rerun")
    result, live, after = tmp_path / "tiny", tmp_path / "live.rrd", tmp_path / "after.rrd"
    done = pliant("run", TINY, "--output", result, "--save", live, *COARSE_MESH)
    assert done.returncode == 0, done.stderr
    assert f"pliant view {result}" in done.stderr
    assert not (result / "session.json").exists()
    done = pliant("view", result, "--save", after)
    assert done.returncode == 0, done.stderr
    printer = Path(sys.executable).with_name("rerun")
    if not printer.is_file():
        pytest.skip(f"the command of rerun {rr.__version__} is not here")
    for path in (live, after):
        printed = subprocess.run([printer, "rrd", "print", path], capture_output=True, text=True)
        assert printed.returncode == 0, printed.stderr
        for entity in (
            "camera",
            "camera/image",
            "camera/image/tracks",
            "world/points/0",
            "world/path",
            "world/mesh/final/0",
        ):
            assert f"/map/{entity}" in printed.stdout, f"{path.name}: {entity}"
        assert "/map/world/mesh/live/" in printed.stdout, path.name


def test_wrong_requests_are_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("rerun")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    there = tmp_path / "there.rrd"
    there.write_text("mine")
    for arguments, says in (
        ((tmp_path / "nothing", "--save", tmp_path / "x.rrd"), "no such recording"),
        (("--save", tmp_path / "x.rrd"), "nothing to view"),
        ((tmp_path, "--save", there), "--force"),
        ((tmp_path, "--save", there, "--web"), "exclude each other"),
        ((tmp_path,), "there is no display"),
        (("--connect", "tcp/127.0.0.1:9", "--save", tmp_path / "x.rrd"), "--session"),
        (("--connect", "a", "--session", "b", "--save", tmp_path / "x.rrd"), "not an endpoint"),
    ):
        done = in_this_process("view", *arguments)
        assert done.returncode == 1
        assert says in done.stderr
        assert done.stderr.count("\n") == 1, done.stderr
    assert there.read_text() == "mine"
    assert not (tmp_path / "x.rrd").exists()


def test_a_view_of_nothing_leaves_what_was_saved_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("rerun")
    monkeypatch.setattr("pliant.bus.session.CONNECT_TIMEOUT_S", 0.3)
    there = tmp_path / "there.rrd"
    there.write_text("mine")
    for source in (("--connect", free_endpoint(), "--session", "none"), (tmp_path / "nothing",)):
        done = in_this_process("view", *source, "--save", there, "--force")
        assert (done.returncode, done.stderr.count("\n")) == (1, 1), done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["there.rrd"]
    assert there.read_text() == "mine"


def test_a_viewer_that_cannot_start_leaves_an_earlier_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("rerun")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    output = tmp_path / "result"
    there = tmp_path / "there.rrd"
    there.write_text("mine")
    check_viewer(output, web=False, save=output / "run.rrd", force=False)
    for save, says in ((None, "no display"), (tmp_path / "a" / "b.rrd", "no such folder")):
        with pytest.raises(ResultError, match=says):
            check_viewer(output, web=False, save=save, force=True)
    with pytest.raises(ResultError, match="--force"):
        run_pipeline(
            RunRequest(source=SourceSpec(location="built-in:tiny"), output=output, save=there)
        )
    assert there.read_text() == "mine"
    assert not output.exists()


def test_a_taken_port_is_one_line() -> None:
    pytest.importorskip("rerun")
    with socket.create_server(("0.0.0.0", 0)) as taken, pytest.raises(ResultError, match="in use"):
        RerunCanvas("web", name="taken", web_port=taken.getsockname()[1])


def test_two_runs_are_shown_in_browsers_at_once() -> None:
    pytest.importorskip("rerun")
    one = RerunCanvas("web", name="one")
    try:
        two = RerunCanvas("web", name="two")
        two.close()
        web_port = int(free_endpoint().rsplit(":", 1)[1])
        three = RerunCanvas("web", name="three", web_port=web_port)
        three.close()
    finally:
        one.close()
    assert len({one.address, two.address, three.address}) == 3
    assert f":{web_port}/" in three.address


def test_two_that_begin_at_once_do_not_share_a_port(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rerun's own was free when both looked, and the other one has it now."""
    pytest.importorskip("rerun")
    free = rerun.free_port
    with socket.create_server(("127.0.0.1", 0)) as web:
        there = {rerun._WEB_PORT: web.getsockname()[1]}
        monkeypatch.setattr(rerun, "free_port", lambda port=None: there.get(port) or free())
        canvas = RerunCanvas("web", name="second")
        try:
            with urlopen(canvas.address) as page:
                assert page.status == 200
        finally:
            canvas.close()


def test_a_browser_may_reach_this_machine_alone() -> None:
    """Rerun's page would fetch fonts, look for updates and report its use."""
    pytest.importorskip("rerun")
    canvas = RerunCanvas("web", name="page")
    try:
        with urlopen(canvas.address) as page:
            policy = page.headers["Content-Security-Policy"]
            content = page.read()
        with urlopen(canvas.address.partition("?")[0] + "re_viewer.js") as script:
            assert "javascript" in script.headers["Content-Type"]
    finally:
        canvas.close()
    assert b"re_viewer.js" in content
    assert b'href="https://' not in content
    assert "default-src 'none'" in policy
    assert "://" not in policy


def answer_to(address: str, host: str) -> int:
    try:
        with urlopen(Request(address, headers={"Host": host})) as page:
            return int(page.status)
    except HTTPError as error:
        return error.code


def test_other_users_and_sites_that_mean_this_machine_see_nothing() -> None:
    """Any local user reaches the port, and a browser by any name that resolves to it."""
    pytest.importorskip("rerun")
    canvas = RerunCanvas("web", name="private")
    try:
        root, _, token = canvas.address.partition("?")[0].rstrip("/").rpartition("/")
        own = root.removeprefix("http://")
        for where in ("/", "/re_viewer.js", "/run.rrd"):
            if where != "/run.rrd":
                assert answer_to(f"{root}/{token}{where}", own) == 200
                assert answer_to(f"{root}/{token}{where}", "127.0.0.1:1") == 200
            for host in ("pliant.example:9090", "pliant.example", "localhost.example", "[", ""):
                assert answer_to(f"{root}/{token}{where}", host) == 403
            for told in (
                where,
                f"/{token[:-1]}{where}",
                f"/%00{where}",
                f"/{token.lower()}{where}",
            ):
                assert answer_to(f"{root}{told}", own) == 404
    finally:
        canvas.close()


def test_a_browser_that_comes_late_gets_the_beginning_and_what_follows(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rr = pytest.importorskip("rerun")
    stream = rr.RecordingStream("late", recording_id="late")
    data = RerunData(stream, most_bytes=30_000)
    with data.staying():
        stream.log("stays", rr.TextLog("stays"), static=True)
    for frame in range(20):  # 5,000 bytes each at least
        stream.set_time("frame", sequence=frame)
        stream.log(f"frame/{frame}", rr.Points3D(np.random.default_rng(frame).random((300, 3))))
        data.take()
    parts = data.since(0)
    assert parts is not None
    assert b"stays" in parts[0][1]
    whole = b"".join(part for _, part in parts)
    assert [b"/frame/0" in whole, b"/frame/19" in whole] == [False, True]
    assert len(whole) < 60_000
    stream.log("after", rr.TextLog("after"))
    data.take()
    later = data.since(parts[-1][0] + 1)
    assert later is not None
    assert b"/after" in later[-1][1]
    monkeypatch.setattr(rerun_data, "_BATCH_BYTES", 10_000)
    some = data.since(0)
    assert some is not None
    assert some == parts[: len(some)]  # a slow one holds no more than it is about to be sent
    assert sum(len(part) for _, part in some[:-1]) < 10_000
    data.close()
    assert data.since(later[-1][0] + 1) is None


@pytest.mark.slow
def test_a_run_that_a_browser_looks_on_at_gives_its_results_and_stays(tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    with subprocess.Popen(
        command("run", TINY, "--view", "web", "--output", tmp_path / "tiny", *NO_MESH),
        stderr=subprocess.PIPE,
        text=True,
    ) as run:
        assert run.stderr is not None
        said = list(itertools.takewhile(lambda line: "until Ctrl-C" not in line, run.stderr))
        try:
            assert run.poll() is None, "".join(said)
            assert (tmp_path / "tiny" / "report.json").is_file(), "".join(said)
            assert not (tmp_path / "tiny" / "session.json").exists()
        finally:
            run.send_signal(signal.SIGINT)
    assert run.returncode == 0


def test_rerun_listens_on_this_machine_alone_and_leaves_with_us() -> None:
    """Its own library would listen to everybody."""
    pytest.importorskip("rerun")
    web_port = int(free_endpoint().rsplit(":", 1)[1])
    canvas = RerunCanvas("web", name="local", web_port=web_port)
    try:
        assert canvas._server is not None
        ports = (web_port, *canvas._server.ports)
        tables = [Path(f"/proc/net/{name}").read_text() for name in ("tcp", "tcp6")]
        rows = [line.split() for table in tables for line in table.splitlines()[1:]]
        addresses = {row[1] for row in rows if row[3] == "0A"}  # those that listen
        for port in ports:
            assert {a for a in addresses if a.endswith(f":{port:04X}")} == {f"0100007F:{port:04X}"}
    finally:
        canvas.close()
    assert not any(listens(port) for port in ports)


def test_ctrl_c_while_rerun_comes_up_leaves_no_server(monkeypatch: pytest.MonkeyPatch) -> None:
    ended: list[int] = []

    def interrupt(_: object, ports: object) -> None:
        raise KeyboardInterrupt

    def close(program: RerunProgram) -> None:
        program._process.kill()
        ended.append(program._process.wait())

    monkeypatch.setattr(RerunProgram, "_wait_until_up", interrupt)
    monkeypatch.setattr(RerunProgram, "close", close)
    with pytest.raises(KeyboardInterrupt):
        RerunProgram([int(free_endpoint().rsplit(":", 1)[1])], ["--serve-web"])
    assert len(ended) == 1


def test_a_viewer_that_does_not_leave_is_not_awaited(monkeypatch: pytest.MonkeyPatch) -> None:
    """As one that is stopped: SIGTERM is nothing to it."""
    code = "import signal as s; s.signal(s.SIGTERM, s.SIG_IGN); print(flush=True); input()"

    class Looking:
        endpoint, session = "tcp/127.0.0.1:1", "run"

        def wait_for_viewer(self, _: float) -> bool:
            return True

    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as stubborn:
        assert stubborn.stdout is not None
        stubborn.stdout.readline()  # from here on it does not listen
        monkeypatch.setattr(spectators.subprocess, "Popen", lambda *_, **options: stubborn)
        for name in ("_LAST_WORDS_S", "_LEAVE_S"):
            monkeypatch.setattr(spectators, name, 0.0)
        with spectators.Viewer(web=False, save=None) as viewer:
            viewer.start(cast(Fleet, Looking()))
            viewer.see_the_end(cast(Fleet, Looking()))
    assert stubborn.returncode == -signal.SIGKILL


def test_a_viewer_that_is_stopped_for_good_changes_nothing(tiny_run: Path) -> None:
    """It stops itself at its first message: whoever waited for it would wait for ever."""
    stopped = run_with("stopped", "built-in:tiny")
    assert stopped.was_stopped
    assert stopped.files == {name: (tiny_run / name).read_bytes() for name in stopped.files}
