"""Which service's death ended a session."""

import subprocess
import sys
import time
from pathlib import Path

import pytest

from pliant_services.runtime.child import Child, first_to_fail

SAYS = "import sys; print('pliant: ' + sys.argv[1], flush=True); sys.stdin.read(); sys.exit(1)"


def service(folder: Path, name: str, words: str) -> Child:
    """One that says so, and fails once nobody writes to it any more."""
    process = subprocess.Popen(
        [sys.executable, "-c", SAYS, words], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    return Child(name, process, folder / f"{name}.log")


def end(child: Child) -> None:
    assert child.process.stdin is not None
    child.process.stdin.close()
    child.process.wait()


def test_who_went_away_is_named_however_long_its_process_takes_to_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reader = service(tmp_path, "tracking", "ingest went away before the end of camera/image")
    source = service(tmp_path, "ingest", "no frame lies there")
    services = [reader, source]
    assert first_to_fail(services) is None
    end(reader)
    waited = []

    def wait(seconds: float) -> None:
        waited.append(seconds)
        if len(waited) == 20:
            end(source)

    monkeypatch.setattr(time, "sleep", wait)
    first = first_to_fail(services)
    assert first is source
    assert first.obituary() == "ingest: no frame lies there"
    for child in services:
        child.close()


def test_if_all_report_a_lost_peer_the_first_is_named(tmp_path: Path) -> None:
    services = [service(tmp_path, name, "router went away") for name in ("tracking", "meshing")]
    for child in services:
        end(child)
    assert first_to_fail(services) is services[0]
    for child in services:
        child.close()
