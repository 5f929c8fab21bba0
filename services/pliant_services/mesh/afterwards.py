"""The mesh of a run whose services may be restarted: fused from the recording at the end.

The state of a mesher is too large for checkpoints, and the recording contains all of its input.  So
a process reads the recording and adds a complete part to it; if it dies, it adds nothing and is
started again.
"""

import subprocess
import sys
from pathlib import Path

from pliant.config import recorded_config
from pliant.errors import PliantError
from pliant.files import put_in_place
from pliant.programs import PYTHON
from pliant.recording.parts import PART, PART_RECORD, folder_of_parts, following_number
from pliant.recording.reader import Recording
from pliant.recording.summary import Summary, summarise
from pliant.recording.writer import RecordingWriter
from pliant.results.folder import RECORDING_NAME
from pliant_services.processes import BY_NAME
from pliant_services.replay.services import record
from pliant_services.runtime.child import Child
from pliant_services.runtime.host import end_with_launcher
from pliant_services.runtime.launcher import MOST_DEATHS, ServiceDiedError

_MESHING = BY_NAME["meshing"]
_PARTIAL = "meshing.partial"


def add_mesh(output: Path) -> None:
    """Mesh the run in a process of its own, started again when it dies, unless it is done.

    output: a result folder whose recording is in parts.  Without a finished map there is no mesh.
    Raises ServiceDiedError when the process fails, or dies three times.
    """
    for attempt in range(1, MOST_DEATHS + 1):
        if not _can_be_meshed(summarise(output / RECORDING_NAME)):
            return
        process = subprocess.Popen(
            [*PYTHON, "-m", __name__, str(output)],
            stdin=subprocess.PIPE,  # never written: it closes when the launcher is gone
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            start_new_session=True,  # Ctrl-C reaches the launcher alone
        )
        child = Child(_MESHING.name, process, output / "logs" / f"{_MESHING.name}.log")
        try:
            process.wait()
        finally:
            process.kill()
            process.wait()
            child.close()
            (folder_of_parts(output / RECORDING_NAME) / _PARTIAL).unlink(missing_ok=True)
        if not child.failed:
            return
        if not child.crashed or attempt == MOST_DEATHS:
            raise ServiceDiedError(child.obituary(), crashed=child.crashed)


def mesh_into_recording(output: Path) -> None:
    """Mesh here and now; the recording has one part more.  Raises RecordingError."""
    path = output / RECORDING_NAME
    recording, summary = Recording(path), summarise(path)
    folder = folder_of_parts(path)
    number = following_number(folder)
    config = recorded_config(summary.metadata, ())
    inputs = {topic: recording.decoded(topic) for topic in _MESHING.inputs}
    with RecordingWriter(
        folder / _PARTIAL, {**summary.metadata, PART_RECORD: {"number": str(number)}}
    ) as writer:
        record(_MESHING, inputs, config, writer)
    put_in_place(folder / _PARTIAL, folder / PART.format(number))


def _can_be_meshed(summary: Summary) -> bool:
    """Whether all that a mesher reads is there, whole, and none has made a mesh of it."""
    known = summary.topics
    made = any(topic.key in known for topic in _MESHING.outputs)
    return not made and all(t.key in known and known[t.key].end for t in _MESHING.inputs)


if __name__ == "__main__":
    end_with_launcher()
    try:
        mesh_into_recording(Path(sys.argv[1]))
    except PliantError as error:
        sys.exit(f"pliant: {error}")
