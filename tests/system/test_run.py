"""``pliant run`` with real processes on free ports."""

import json
import os
import shutil
import signal
import threading
import time
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from running import (
    NO_MESH,
    TIMEOUT_S,
    TINY,
    UP,
    assert_one_line,
    children,
    has_ended,
    in_this_process,
    pliant,
    running,
)

from pliant.bus.session import CONNECT_TIMEOUT_S, free_endpoint, open_router
from pliant.errors import RecordingError
from pliant.messages import topics
from pliant.recording.reader import Recorded, Recording
from pliant.recording.summary import summarise
from pliant_services.processes import COMPILED

pytestmark = pytest.mark.system


@pytest.fixture
def result(tiny_run: Path) -> Path:
    return tiny_run


def test_a_run_leaves_everything_a_user_opens(result: Path) -> None:
    report = json.loads((result / "report.json").read_text())
    assert report["complete"]
    assert report["frames"] == report["frames_with_pose"] > 10
    assert report["points"] > 100
    for name in ("trajectory.txt", "trajectory_online.txt", "keyframes.txt", "config.yaml"):
        assert (result / name).stat().st_size > 0
    assert (result / "points.ply").read_bytes().startswith(b"ply\nformat binary_little_endian")
    assert len(np.loadtxt(result / "trajectory.txt")) == report["frames"]
    page = (result / "report.html").read_text()
    assert all(f"<th>{name}</th>" in page for name in ("mesh.ply", "map.pliant", "recording.mcap"))


def test_nothing_is_missing_in_the_recording(result: Path) -> None:
    report = json.loads((result / "report.json").read_text())
    frames: dict[str, list[int]] = {}
    for recorded in Recording(result / "recording.mcap").messages():
        frames.setdefault(recorded.topic.key, []).append(recorded.decode().frame)
    for topic in (topics.SOURCE, topics.EXTREMA, topics.MAP_UPDATE):
        assert frames[topic.key] == list(range(report["frames"])), topic.key
    assert len(frames[topics.STREAM.key]) == len(frames[topics.MAP_FINAL.key]) == 1
    metadata = Recording(result / "recording.mcap").metadata()
    assert metadata["config"]["yaml"] == (result / "config.yaml").read_text()
    assert metadata["packages"]["numpy"]


def test_an_existing_result_is_not_overwritten(result: Path) -> None:
    done = in_this_process("run", TINY, "--output", result)
    assert_one_line(done, "--force")


def test_evaluation_of_a_run(result: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(result, tmp_path / "result")
    done = in_this_process(
        "eval", folder, "--groundtruth", TINY, "--json", folder / "evaluation.json"
    )
    assert done.returncode == 0, done.stderr
    figures = json.loads((folder / "evaluation.json").read_text())
    assert figures["final"]["success"]


def test_ctrl_c_ends_the_stream_and_keeps_what_was_done(tmp_path: Path) -> None:
    """Also where the whole group gets it, as from a terminal: a viewer sees the run to its end."""
    folder = tmp_path / "stopped"
    save = ("--save", tmp_path / "run.rrd") if find_spec("rerun") else ()
    # Live at the pace of its stamps, so that the run is still going on when the signal comes.
    with running(
        *(TINY, "--output", folder, "--mode", "live"), *save, start_new_session=True
    ) as run:
        run.wait_for(UP)
        os.killpg(run.process.pid, signal.SIGINT)
        code, output, errors = run.finish()
    assert code == 130, errors
    assert errors.endswith("pliant: interrupted\n")
    assert errors.count("interrupted") == 1
    assert not save or str(save[1]) in output  # said by a viewer that was done
    report = json.loads((folder / "report.json").read_text())
    recorded = [m.sequence for m in Recording(folder / "recording.mcap").messages(topics.EXTREMA)]
    assert len(recorded) == report["frames"]
    assert not report["complete"] or report["frames"] > 0
    assert "frames" in output
    summary = summarise(folder)
    assert summary.closed
    assert not summary.missing
    assert not summary.damage


def test_a_service_that_dies_is_named_with_its_last_words(tmp_path: Path) -> None:
    folder = tmp_path / "died"
    # On the disk after every message, so that it is seen there.
    arguments = [TINY, "--output", folder, "--mode", "live", *NO_MESH, "--set"]
    with running(*arguments, "recorder.sync_interval_s=1e-9") as run:
        run.wait_for(UP)
        run.send(signal.SIGSTOP, "tracking")  # it does not come to its end before
        pause, deadline = threading.Event(), time.monotonic() + TIMEOUT_S
        while not stream_of(folder) and time.monotonic() < deadline:
            pause.wait(0.02)
        run.send(signal.SIGKILL, "tracking")
        code, _, errors = run.finish()
    assert code == 1
    assert "tracking was killed by SIGKILL" in errors
    assert stream_of(folder)


def stream_of(folder: Path) -> list[Recorded]:
    """What its recording has of the stream by now."""
    try:
        return list(Recording(folder / "recording.mcap").messages(topics.STREAM))
    except RecordingError:  # it has not begun
        return []


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["run", TINY, "--set", "tracking.max_trakcs=5"], "did you mean"),
        (["eval", "none", "--groundtruth", TINY], "none"),
        (["service", "ingest", "--connect", "tcp/127.0.0.1:1"], "--source"),
    ],
)
def test_a_mistake_is_one_line_of_the_real_command(
    tmp_path: Path, arguments: Sequence[str], text: str
) -> None:
    assert_one_line(pliant(*arguments, cwd=tmp_path), text)


def test_a_port_in_use_is_one_line(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    with open_router(endpoint):
        port = endpoint.rsplit(":", 1)[1]
        done = pliant("run", TINY, "--output", tmp_path / "r", "--port", port)
    assert_one_line(done, "in use")


def test_a_service_without_its_peers_reports_it_within_ten_seconds(tmp_path: Path) -> None:
    unused = free_endpoint()
    done = pliant("service", "tracking", "--connect", unused)
    assert_one_line(done, "cannot reach")
    assert CONNECT_TIMEOUT_S < 8.0  # and two for Python and Zenoh to start: no clock under load


def test_ctrl_c_while_kernels_are_compiled(result: Path, tmp_path: Path) -> None:
    """It reaches the compilers, too, as a terminal's does; an earlier result stays as it is."""
    before = {path.name: path.read_bytes() for path in result.iterdir() if path.is_file()}
    with running(
        *(TINY, "--output", result, "--force"),
        env={"NUMBA_CACHE_DIR": str(tmp_path)},
        start_new_session=True,
    ) as run:
        run.wait_for("compiling")
        os.killpg(run.process.pid, signal.SIGINT)
        code, output, errors = run.finish()
    assert (code, output, errors) == (130, "", "pliant: interrupted\n")
    assert before == {path.name: path.read_bytes() for path in result.iterdir() if path.is_file()}


def test_compilers_end_with_a_launcher_that_was_killed(tmp_path: Path) -> None:
    with running(TINY, "--output", tmp_path / "run", env={"NUMBA_CACHE_DIR": str(tmp_path)}) as run:
        run.wait_for("compiling")
        compilers: list[int] = []
        while len(compilers) < len(COMPILED):
            assert run.process.poll() is None
            compilers = children(run.process.pid, "warm_up")
        run.send(signal.SIGKILL)
        assert all(has_ended(pid, 30.0) for pid in compilers)
