"""The address of an active run: ``session.json`` in its result folder.

It is used only while a process holds the folder, and only for an endpoint on this machine: a killed
run leaves its file behind, and the folder may be a foreign one.
"""

import json
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path

from pliant.bus.session import is_beyond_loopback
from pliant.files import write_whole
from pliant.results.folder import SESSION_NAME, is_being_written

_LOCAL = ("unixsock-stream/", "tcp/")
_MORE = frozenset("#?;")
"""Zenoh takes what follows for a configuration of the link."""


@contextmanager
def announced(output: Path, endpoint: str, session: str) -> Generator[None]:
    """Leave ``session.json`` in the result folder during the run."""
    file, content = output / SESSION_NAME, json.dumps({"endpoint": endpoint, "session": session})
    with suppress(OSError):  # a full disk has a line of its own
        write_whole(file, content, synced=False)
    try:
        yield
    finally:
        with suppress(OSError, ValueError):
            if file.read_text(encoding="utf-8") == content:  # another folder may be there now
                file.unlink()


def running_session(result: Path) -> tuple[list[str], str]:
    """The endpoint and name of the run that is writing this result; ([], "") if none is."""
    try:
        content = json.loads((result / SESSION_NAME).read_text(encoding="utf-8"))
        endpoint, session = str(content["endpoint"]), str(content["session"])
    except (OSError, ValueError, KeyError, TypeError):
        return [], ""
    local = endpoint.startswith(_LOCAL) and not is_beyond_loopback(endpoint)
    believed = local and not _MORE.intersection(endpoint) and is_being_written(result)
    return ([endpoint], session) if believed else ([], "")
