"""A service that no launcher watches, and the end of a session of such services.

Each writes a mark next to its checkpoints when it has finished.  If a supervisor starts it again
after that, it exits at once.  The recorder is the last: it writes the results, then announces the
end of the session.
"""

import sys
import time
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

from pliant.bus.peers import OVER_KEY
from pliant.bus.session import open_session
from pliant.config import Config, config_yaml
from pliant.errors import ResultError, SessionOverError, SourceLostError
from pliant.exit_codes import DONE
from pliant.files import make_folder, mark, put_in_place, write_whole
from pliant.recording import parts
from pliant.results.folder import (
    CONFIG_NAME,
    RECORDING_NAME,
    recorded_into,
    settle_killed,
    written,
)
from pliant_services.processes import BY_NAME, PROCESSES
from pliant_services.runtime.host import ServiceOptions, run_service

_MARK = "over"
_LOOK_S = 0.5
_SAY_S = 3.0
_SAY_AGAIN_S = 0.05


def run_alone(name: str, config: Config, options: ServiceOptions, *, results: bool) -> int:
    """Run a service to the end of its part; returns the exit code.

    results: the recorder also writes the results, and ends the session.  Raises PliantError.
    """
    output: Path | None = options.arguments.get("output")
    recorded = output if results and BY_NAME[name].observer else None
    code = DONE
    if not _is_done(name, options.state, recorded):
        if recorded is not None:
            settle_killed(recorded.parent)
            _check_recording(recorded, options.state)
        with _held(output, results=recorded is not None):
            try:
                run_service(name, config, options)
            except SessionOverError as over:
                print(over, file=sys.stderr)
            except SourceLostError:  # what came before it is sent
                _leave(options.state, name)
                raise
            if recorded is not None:
                code = _write_results(recorded, config)
                _join_parts(recorded)
        _leave(options.state, name)
    else:
        print(f"{name}: already finished in this session", file=sys.stderr)
    if recorded is not None:
        _announce_end(options)
    return code


def _held(output: Path | None, *, results: bool) -> AbstractContextManager[object]:
    """The folder that a recorder writes to, so that no other process replaces its content."""
    if output is None:
        return nullcontext()
    return written(output.parent, force=True) if results else recorded_into(output.parent)


def _announce_end(options: ServiceOptions) -> None:
    """Tell everybody that the session is over.

    Again and again until the router has left, as it may listen already but not yet take anything
    in; one that stays does not answer, so for some seconds at most.
    """
    with open_session(options.endpoints, options.identity) as connection:
        enough = time.monotonic() + _SAY_S
        while connection.info.routers_zid() and time.monotonic() < enough:
            connection.put(f"pliant/{options.session}/{OVER_KEY}", b"")
            time.sleep(_SAY_AGAIN_S)


def wait_until_over(state: Path) -> None:
    """Return when the recorder has left its mark in this folder, perhaps long ago."""
    while not is_over(state, "recorder"):
        time.sleep(_LOOK_S)


def _is_done(name: str, state: Path | None, recorded: Path | None) -> bool:
    """Whether an earlier start of this service has done everything."""
    if state is None:
        return False
    joined = recorded is not None and recorded.exists() and (state / name).is_dir()
    return joined or is_over(state, name)


def is_over(state: Path, name: str) -> bool:
    """Whether a service has done its part, or the whole session is over.

    The latter is seen where the recorder keeps its mark in the same folder.
    """
    observers = (process.name for process in PROCESSES if process.observer)
    return any((state / each / _MARK).exists() for each in (name, *observers))


def _leave(state: Path | None, name: str) -> None:
    """Leave the mark; checkpoints are not needed any more."""
    if state is None:
        return
    folder = state / name
    make_folder(folder)
    mark(folder / _MARK)
    for kind in ("*.state", "*.constant"):
        for checkpoint in folder.glob(kind):
            checkpoint.unlink(missing_ok=True)


def _check_recording(output: Path, state: Path | None) -> None:
    """Raise ResultError if the results cannot go there, or another session's are there."""
    if output.name != RECORDING_NAME:
        raise ResultError(f"{output}: --results needs a recording named {RECORDING_NAME}")
    own = state / "recorder" if state is not None else None
    if parts.exists(output) and not (own is not None and own.is_dir()):
        raise ResultError(f"{output.parent} already contains a recording: choose another folder")
    try:
        make_folder(output.parent)
        if own is not None:
            make_folder(own)
    except OSError as error:
        raise ResultError(f"{output.parent}: cannot be written: {error.strerror}") from None


def _write_results(output: Path, config: Config) -> int:
    """Write the results beside the recording, and print a summary."""
    # They load the kernels, which a recorder that records has no use for.
    from pliant.results.verdict import grade, summary
    from pliant.results.write import write_results

    report = write_results(output.parent)
    write_whole(output.parent / CONFIG_NAME, config_yaml(config))
    for line in summary(report):
        print(line, flush=True)
    return grade(report)


def _join_parts(output: Path) -> None:
    """A recording in a single part becomes a single file."""
    folder = parts.folder_of_parts(output)
    files = parts.parts_of(folder)
    if len(files) == 1 and not output.exists():
        put_in_place(files[0], output)
        folder.rmdir()
