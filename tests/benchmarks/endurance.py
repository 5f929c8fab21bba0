"""An hour's worth of frames at full speed: do memory, file handles and threads stay as they are?"""

import math
import tempfile
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np

from benchmarks.table import markdown
from pliant.config import config_yaml, load_config
from pliant.datasets.builtin import builtin_folder
from pliant.datasets.source_spec import SourceSpec
from pliant.messages.types import Status
from pliant.results.folder import prepare
from pliant_services.profiles import PROFILES
from pliant_services.run.command import RunRequest, service_arguments
from pliant_services.runtime import kernels as warm_up
from pliant_services.runtime.launcher import Fleet

SERVICES = PROFILES["points"]
_LOOK_S = 1.0
_FPS = 30.0
_WARM_FRAMES = 600  # until the map of the whole scene is there, and every buffer has been used once


def measure(source: str, frames: int, minutes: float) -> Iterator[str]:
    """Memory of each service in the first and the last half; stops after so many minutes.

    The frames are the source's, forth and back, so that the camera never jumps.
    """
    warm_up.compile_kernels(print)
    config = load_config(overrides=["recorder.images=false"])  # the disk is not what is measured
    samples: dict[str, list[tuple[int, ...]]] = {name: [] for name in SERVICES}
    done = 0

    def on_status(status: Status) -> None:
        nonlocal done
        if status.service == "bundle_adjustment":
            done = status.frame + 1

    with tempfile.TemporaryDirectory(prefix="pliant-endurance-") as folder:
        endless = forth_and_back(builtin_folder(source), Path(folder) / "source", frames, _FPS)
        request, output = (
            RunRequest(source=SourceSpec(location=str(endless))),
            Path(folder) / "output",
        )
        prepare(output, config_yaml(config))
        fleet = Fleet(SERVICES, log_folder=output / "logs", on_status=on_status)
        try:
            fleet.start(lambda name: service_arguments(name, request, output))
            start = time.monotonic()
            # Looked at while the source goes on: who has read the end leaves, one after the other.
            while done < frames - 2 and time.monotonic() - start < 60.0 * minutes:
                time.sleep(_LOOK_S)
                if done >= _WARM_FRAMES:
                    for name, pid in fleet.pids.items():
                        with suppress(OSError):
                            samples[name].append(_look_at(pid))
            spent_s = time.monotonic() - start
            fleet.end_source()
            fleet.wait()
        finally:
            fleet.close()
    if min(map(len, samples.values())) < 4:
        yield f"{done} frames are too few: nothing is compared before {_WARM_FRAMES} of them"
        return
    yield f"{done} frames in {spent_s / 60.0:.1f} minutes; compared after the first {_WARM_FRAMES}"
    heading = ("service", "MiB, first half", "last half", "ratio", "handles", "threads")
    yield markdown(heading, [_row(name, np.array(seen)) for name, seen in samples.items()])


def forth_and_back(folder: Path, made: Path, frames: int, fps: float) -> Path:
    """A folder with so many frames: those of another one, again and again."""
    made.mkdir()
    for name in ("images", "calib.yaml"):
        (made / name).symlink_to(folder / name)
    lines = (folder / "rgb.txt").read_text().splitlines()
    once = [line.split()[1] for line in lines if not line.startswith("#")]
    period = once + once[-2:0:-1]
    names = (period * math.ceil(frames / len(period)))[:frames]
    rows = (f"{number / fps:.9f} {name}\n" for number, name in enumerate(names))
    (made / "rgb.txt").write_text("".join(rows))
    return made


def _look_at(pid: int) -> tuple[int, ...]:
    """Resident memory in KiB, open files, threads."""
    words = (Path("/proc") / str(pid) / "status").read_text().split()
    resident, threads = (int(words[words.index(key) + 1]) for key in ("VmRSS:", "Threads:"))
    return resident, len(list((Path("/proc") / str(pid) / "fd").iterdir())), threads


def _row(name: str, seen: np.ndarray) -> tuple[str, ...]:
    half = len(seen) // 2
    first, last = seen[:half], seen[half:]
    before, after = first[:, 0].mean() / 1024.0, last[:, 0].mean() / 1024.0
    counts = (f"{first[:, column].max()}, {last[:, column].max()}" for column in (1, 2))
    return (name, f"{before:.1f}", f"{after:.1f}", f"{after / before:.3f}", *counts)
