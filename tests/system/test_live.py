"""Live mode with a bundle adjustment that stands still for a time: tracking goes on without it."""

import os
import signal
import threading
from pathlib import Path

import pytest
from benchmarks.endurance import forth_and_back
from running import TINY, in_this_process

from pliant.config import config_yaml, load_config
from pliant.datasets.builtin import builtin_folder
from pliant.datasets.source_spec import SourceSpec
from pliant.messages import topics
from pliant.messages.types import PASSED_OVER, Extrema, MapUpdate, SourceImage, Status
from pliant.recording.reader import Recording
from pliant.results.folder import RECORDING_NAME, prepare
from pliant.results.verdict import summary
from pliant.results.write import write_results
from pliant_services.profiles import PROFILES
from pliant_services.run.command import RunRequest, service_arguments
from pliant_services.runtime import kernels as warm_up
from pliant_services.runtime.launcher import Fleet

pytestmark = pytest.mark.system

FRAMES, FPS = 40, 10.0  # slow enough for tracking on a busy machine
PATIENCE_S = 120.0
WINDOW = 4
STOP_FRAME, GO_FRAME = 10, 34
"""Bundle adjustment stands still from the one until tracking has told of the other."""


def test_tracking_continues_and_the_run_can_be_replayed(tmp_path: Path) -> None:
    warm_up.compile_kernels(print)
    output = tmp_path / "run"
    config = load_config(overrides=["ingest.mode=live", f"bus.window={WINDOW}"])
    source = forth_and_back(builtin_folder(TINY), tmp_path / "source", FRAMES, FPS)
    request = RunRequest(source=SourceSpec(location=str(source)))
    prepare(output, config_yaml(config))
    stood_still: list[bool] = []

    def on_status(status: Status) -> None:
        if not stood_still and status.service == "tracking" and status.frame >= STOP_FRAME:
            os.kill(fleet.pids["bundle_adjustment"], signal.SIGSTOP)
            stood_still.append(True)
        elif len(stood_still) == 1 and status.service == "tracking" and status.frame >= GO_FRAME:
            os.kill(fleet.pids["bundle_adjustment"], signal.SIGCONT)
            stood_still.append(False)

    fleet = Fleet(PROFILES["points"], log_folder=output / "logs", on_status=on_status)

    def end() -> None:
        os.kill(fleet.pids["bundle_adjustment"], signal.SIGKILL)  # tracking waits for it

    patience = threading.Timer(PATIENCE_S, end)
    try:
        fleet.start(lambda name: service_arguments(name, request, output))
        patience.start()
        fleet.wait()
    finally:
        patience.cancel()
        fleet.close()
    assert stood_still == [True, False]
    report = write_results(output)
    recording = Recording(output / RECORDING_NAME)
    sources = [m for m in recording.decoded(topics.SOURCE) if isinstance(m, SourceImage)]
    tracks = [m for m in recording.decoded(topics.EXTREMA) if isinstance(m, Extrema)]
    updates = [m for m in recording.decoded(topics.MAP_UPDATE) if isinstance(m, MapUpdate)]
    over = [m.frame for m in sources if m.unmapped]
    assert [m.frame for m in tracks] == [m.frame for m in updates] == list(range(FRAMES))
    assert all(len(tracks[frame].ids) > 100 for frame in over)
    unplaced = [m.frame for m in sources if m.unplaced]
    late = {m.frame for m in updates if m.reason == PASSED_OVER}
    assert {*unplaced} <= late <= {*over}
    assert {*report["frames_passed_over"]} <= late
    assert len([frame for frame in over if STOP_FRAME < frame <= GO_FRAME]) > WINDOW
    placed = [m.frame for m in updates if m.frame in m.pose_frames]
    assert {*over} - {*unplaced} & {*placed}
    assert any(f"{len(over)} images not mapped" in line for line in summary(report))
    # The first image of those that stood still is as old as they are many.
    age = report["image_age_ms"]
    assert 0.0 < age["p50"] < age["p99"]
    assert age["p99"] > 1e3 * (GO_FRAME - STOP_FRAME) / FPS / 2
    assert any("age of an image when its pose is published" in line for line in summary(report))
    again = ("replay", output / RECORDING_NAME, "--services", "tracking,bundle_adjustment")
    done = in_this_process(*again, "--output", tmp_path / "again", "--check")
    assert done.returncode == 0, done.stderr
