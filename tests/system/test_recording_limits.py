"""The recording at its limits: a full disk, kill -9, random delays."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from benchmarks.recorder_kills import measure
from running import AS_FROM_A_SHELL, NO_MESH, TINY, in_this_process

from pliant.config import config_yaml, load_config
from pliant.messages import topics
from pliant.recording.compare import compare
from pliant.recording.reader import Recording
from pliant.recording.summary import summarise
from pliant.results.folder import prepare
from pliant_services.runtime.launcher import Fleet

pytestmark = pytest.mark.system

DETERMINISTIC = [t for t in topics.TOPICS if t.logged and t.deterministic]


def assert_same(a: Path, b: Path) -> None:
    found = compare(Recording(a), Recording(b), [t for t in DETERMINISTIC if t.per_frame])
    assert not found, found
    assert summarise(b).complete


def test_the_report_proves_that_nothing_was_lost(tiny_run: Path) -> None:
    report = json.loads((tiny_run / "report.json").read_text())
    proof = report["recorder"]
    assert (proof["lost"], proof["duplicated"]) == (0, 0)
    for topic in (topics.SOURCE, topics.EXTREMA, topics.MAP_UPDATE):
        assert proof["messages"][topic.key] == report["frames"]


def test_the_same_bytes_with_delays_a_busy_core_and_another_order_of_start(
    tiny_run: Path, tmp_path: Path
) -> None:
    names = ("recorder", "tracking", "ingest", "bundle_adjustment")
    prepare(tmp_path, config_yaml(load_config()))

    def arguments(name: str) -> list[str]:
        extra = ["--config", str(tmp_path / "config.yaml"), "--delays-ms", "40"]
        if name == "ingest":
            extra += ["--source", TINY]
        if name == "recorder":
            extra += ["--output", str(tmp_path / "recording.mcap")]
        return extra

    busy = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    fleet = Fleet(names, log_folder=tmp_path / "logs", on_status=lambda _: None)
    try:
        fleet.start(arguments)
        fleet.wait()
    finally:
        fleet.close()
        busy.kill()
        busy.wait()
    assert_same(tiny_run, tmp_path)


def test_a_full_disk_is_one_line_and_what_was_written_is_readable(tmp_path: Path) -> None:
    """No file may grow beyond a third of a recording: what a full disk looks like to its writer.

    Room for two chunks, so that a machine too quick to reach the first second writes some, too.
    """
    code = (
        "import resource, runpy, sys;"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (3 << 20, 3 << 20));"
        "sys.argv = ['pliant', *sys.argv[1:]];"
        "runpy.run_module('pliant_services.cli', run_name='__main__')"
    )
    run = ["run", f"{TINY}?frames=30", "--output", str(tmp_path / "r"), *NO_MESH]
    done = subprocess.run(
        [*AS_FROM_A_SHELL, sys.executable, "-c", code, *run],
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert "the disk is full; the recording so far stays readable" in done.stderr
    summary = summarise(tmp_path / "r")
    assert not summary.closed
    assert summary.topics[topics.EXTREMA.key].messages > 2
    assert not summary.topics[topics.EXTREMA.key].gaps


def test_a_recording_without_images_lists_what_cannot_be_replayed(tmp_path: Path) -> None:
    folder = tmp_path / "small"
    in_this_process("run", f"{TINY}?frames=12", "--output", folder, "--no-images", *NO_MESH)
    summary = summarise(folder)
    assert summary.complete
    assert topics.SOURCE.key not in summary.topics
    done = in_this_process("replay", folder, "--services", "tracking")
    assert done.returncode == 1
    assert "tracking cannot be replayed: the recording is without camera/source" in done.stderr


def test_kill_9_of_the_recorder_costs_a_second_at_most() -> None:
    assert "3 of 3" in "".join(measure(3))
