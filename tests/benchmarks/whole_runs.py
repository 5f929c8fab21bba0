"""Whole runs, many times: is anything lost, what does recording cost, when is the first frame?"""

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from statistics import median

from benchmarks.table import markdown, markdown_header, markdown_row
from pliant.config import config_yaml, load_config
from pliant.datasets.source_spec import SourceSpec
from pliant.errors import PliantError
from pliant.exit_codes import DONE, INCOMPLETE
from pliant.messages import topics
from pliant.messages.topics import Topic
from pliant.messages.types import Status
from pliant.recording.reader import Recording
from pliant.results.folder import RECORDING_NAME, prepare
from pliant.results.write import write_results
from pliant_services.profiles import PROFILES
from pliant_services.run.command import RunRequest, service_arguments
from pliant_services.runtime import kernels as warm_up
from pliant_services.runtime.launcher import Fleet

SERVICES = PROFILES["points"]
FILES = ("trajectory.txt", "trajectory_online.txt", "keyframes.txt", "points.ply")


def losses(source: str, runs: int) -> Iterator[str]:
    """Run a source again and again at full speed: the recorder's books, and whether bytes agree."""
    first: dict[str, bytes] = {}
    yield markdown_header(("run", "messages", "lost", "twice", "the same bytes"))
    for number in range(runs):
        with tempfile.TemporaryDirectory() as folder:
            output = Path(folder)
            run_once(source, output, SERVICES)
            books = write_results(output)["recorder"]
            files = {name: (output / name).read_bytes() for name in FILES}
        first = first or files
        yield markdown_row(
            (
                str(number + 1),
                str(sum(books["messages"].values())),
                str(books["lost"]),
                str(books["duplicated"]),
                "yes" if files == first else "NO",
            )
        )


def recording_cost(source: str, runs: int) -> Iterator[str]:
    """Frames a second of the pipeline with and without a recorder, run in turns."""
    with_recorder = SERVICES
    without = tuple(name for name in with_recorder if name != "recorder")
    rates: dict[str, list[float]] = {"on": [], "off": []}
    for _ in range(runs):
        for name, services in (("on", with_recorder), ("off", without)):
            with tempfile.TemporaryDirectory() as folder:
                rates[name].append(run_once(source, Path(folder), services))
    on, off = median(rates["on"]), median(rates["off"])
    rows = [("off", f"{off:.1f}", "1.00"), ("on", f"{on:.1f}", f"{on / off:.2f}")]
    yield markdown(("recording", "frames/s", "of that without"), rows)


def first_frame(source: str, runs: int) -> Iterator[str]:
    """Seconds from the start of ``pliant run`` to the first frame, by the clock of the recorder."""
    arrived: dict[Topic, list[float]] = {topics.SOURCE: [], topics.MAP_UPDATE: []}
    for number in range(runs + 1):
        with tempfile.TemporaryDirectory() as folder:
            output = Path(folder) / "run"
            options = ("--end", "2", "--output", str(output))
            command = ("-m", "pliant_services.cli", "run", source, *options)
            began_ns = time.time_ns()
            done = subprocess.run([sys.executable, *command], stdout=subprocess.DEVNULL)
            if done.returncode not in (DONE, INCOMPLETE):
                raise PliantError(f"{source}: does not run")
            if number == 0:
                continue  # which compiled the kernels, and rendered the source
            for topic, seconds in arrived.items():
                first = next(Recording(output / RECORDING_NAME).messages(topic))
                seconds.append((first.log_time_ns - began_ns) * 1e-9)
    rows = [(topic.key, f"{median(seconds):.2f}") for topic, seconds in arrived.items()]
    yield markdown(("first message of", "s after the start"), rows)


def run_once(
    source: str,
    output: Path,
    services: Sequence[str],
    *,
    beside: Callable[[Fleet], AbstractContextManager[object]] = nullcontext,
) -> float:
    """One run; returns its frames a second.   beside: entered before the services start."""
    warm_up.compile_kernels(print)
    request = RunRequest(source=SourceSpec(location=source))
    prepare(output, config_yaml(load_config()))
    times: list[float] = []

    def on_status(status: Status) -> None:
        if status.service == "bundle_adjustment":
            times.append(time.monotonic())

    fleet = Fleet(services, log_folder=output / "logs", on_status=on_status)
    try:
        with beside(fleet):
            fleet.start(lambda name: service_arguments(name, request, output))
            fleet.wait()
    finally:
        fleet.close()
    return (len(times) - 1) / (times[-1] - times[0])
