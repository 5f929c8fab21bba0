"""kill -9 of the recorder at random moments: what recovery keeps."""

import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from pliant.errors import PliantError
from pliant.messages import topics
from pliant.recording.reader import Recording
from pliant.recording.recover import recover
from pliant.recording.summary import summarise

_RATE_HZ = 30.0
_SECONDS = (0.3, 4.0)

_RECORDER = """
import sys, time, threading
from pathlib import Path
from pliant.bus.base import Received
from pliant.config import Config
from pliant.messages import codec
from pliant_services.nodes import recorder
from benchmarks.recording import synthetic

class Bus:
    taken = 0
    def receive_any(self, *, timeout_s=None):
        frames = [synthetic(n) for n in range(10)]
        pause, start = threading.Event(), time.monotonic()
        print("up", flush=True)
        for n in range(10**6):
            for topic, message in frames[n % 10]:
                again = dict(vars(message)) | {"frame": n}
                yield Received(topic, 0, n, False, codec.encode(type(message)(**again)))
            self.taken = n + 1
            print(f"taken {n + 1} {time.monotonic()}", flush=True)
            pause.wait(max(0.0, start + n / RATE - time.monotonic()))
    def acknowledge(self):
        print(f"safe {self.taken}", flush=True)

recorder.run(Bus(), Config(), Path(sys.argv[1]), {})
"""


def measure(kills: int) -> Iterator[str]:
    """Kill a recorder of 30 frames/s so often.  Raises PliantError where more is lost than may."""
    random = np.random.default_rng(0)
    worst_s, kept = 0.0, 0
    with tempfile.TemporaryDirectory(prefix="pliant-kills-") as folder:
        for number in range(kills):
            path = Path(folder) / f"{number}.mcap"
            lost_s, safe, found = _one(path, float(random.uniform(*_SECONDS)))
            if found < safe or lost_s > 1.0:
                raise PliantError(
                    f"kill {number}: {found} frames kept, {safe} acknowledged, "
                    f"the last {lost_s:.2f} s lost"
                )
            worst_s, kept = max(worst_s, lost_s), kept + 1
    yield f"{kept} of {kills}: all but at most the last {worst_s:.2f} s kept, all acknowledged kept"


def _one(path: Path, after_s: float) -> tuple[float, int, int]:
    """Seconds lost, frames that were acknowledged, frames that were recovered."""
    code = _RECORDER.replace("RATE", str(_RATE_HZ))
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(path)],
        stdout=subprocess.PIPE,
        text=True,
        env={
            **os.environ,
            "PYTHONPATH": os.pathsep.join(sys.path),
        },  # this package is not installed
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "up\n"
    killer = threading.Timer(after_s, process.send_signal, [signal.SIGKILL])
    killer.start()
    lines = process.stdout.read().splitlines()
    killed = time.monotonic()
    if process.wait() != -signal.SIGKILL:
        raise PliantError("the recorder ended by itself, before it was killed")
    process.stdout.close()
    killer.join()
    whole = path.with_name("whole.mcap")
    recover(path, whole)
    assert summarise(whole).has_index
    frames = [m.sequence for m in Recording(whole).messages(topics.EXTREMA)]
    assert frames == list(range(len(frames)))
    words = [line.split() for line in lines]
    safe = max((int(w[1]) for w in words if w[0] == "safe" and len(w) == 2), default=0)
    taken = [float(w[2]) for w in words if w[0] == "taken" and len(w) == 3]
    lost_since = taken[len(frames)] if len(frames) < len(taken) else killed
    return killed - lost_since, safe, len(frames)
