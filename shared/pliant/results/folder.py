"""A result folder: its file names, its lock, and its state before a run."""

import errno
import fcntl
import json
import os
import platform
import re
import subprocess
import sys
from collections.abc import Generator, Iterable, Iterator
from contextlib import contextmanager, suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any

from pliant.arithmetic import target
from pliant.errors import PliantError, ResultError
from pliant.files import is_folder, make_folder, move_all, sync, sync_all, write_whole
from pliant.messages import topics
from pliant.recording import parts
from pliant.recording.map_file import MAP_NAME
from pliant.recording.reader import Recorded, Recording
from pliant.recording.scan import NothingReadableError
from pliant.results import earlier
from pliant.results.locking import LOCK_NAME, Held, held, holder_of
from pliant.staging import clear_staging, staging
from pliant.version import __version__

RECORDING_NAME = "recording.mcap"
CONFIG_NAME = "config.yaml"
REPORT_NAME = "report.json"
PAGE_NAME = "report.html"
STATE_FOLDER = "state"
"""Folder of the services' checkpoints, during a run that may be restarted."""
SESSION_NAME = "session.json"
"""File with the endpoint and session, during a run."""
CALIBRATION_NAME = "calibration.yaml"
TRAJECTORY_NAME = "trajectory.txt"
ONLINE_NAME = "trajectory_online.txt"
SURFELS_NAME = "surfels.npz"
DEFORMING_MAP_NAME = "deforming_map.npz"
_RIGID_FILES = (
    TRAJECTORY_NAME,
    ONLINE_NAME,
    "keyframes.txt",
    "points.ply",
    CALIBRATION_NAME,
    REPORT_NAME,
    PAGE_NAME,
)
SURFEL_FILES = (TRAJECTORY_NAME, SURFELS_NAME, REPORT_NAME, PAGE_NAME)
SCALE_NAME = "scale.yaml"
MESH_ERROR_NAME = "mesh_error.png"
SOMETIMES = (MAP_NAME, SCALE_NAME, MESH_ERROR_NAME, DEFORMING_MAP_NAME)
"""Files of a completed map, of a map with a known scale, of an evaluated mesh, and of a map that
deforms."""
MESH_FILES = ("mesh.ply", "mesh_coarse.ply", "mesh.png", "mesh_shaded.png", "mesh_normals.png")
_SWITCHING = ".results-whole"
"""Complete results that are about to be moved into place."""
_LOGS, _METADATA = "logs", "metadata.json"
_OF_SEGMENT = re.compile(r"_segment_\d+(?=\.\w+$)")
_OF_FRAMES = (topics.SOURCE, topics.EXTREMA, topics.SURFELS)
"""Every frame is in one of these, whatever the profile, even if images are not recorded."""
_VERSIONS = ("eclipse-zenoh", "mcap", "msgpack", "numba", "numpy", "opencv-python-headless")


def folder_name(source: str) -> str:
    """The name of the result folder of a source."""
    name = source.rstrip("/").rsplit("/", 1)[-1]
    if name in ("", ".", ".."):
        name = Path(source).resolve().name
    return re.sub(r"[^\w.-]+", "_", name) or "run"


def keep_apart(output: Path, read: Iterable[Path], *, option: str = "--output") -> None:
    """Raise ResultError if an output would overwrite an input of the command.

    read: files and folders that may neither be the output nor lie in it, after links and ``..`` are
    resolved.  option: the one that names the output.
    """
    where = output.resolve()
    for path in read:
        # A link in the output is lost with it, though what it points to is not.
        for found in (path.resolve(), path.parent.resolve() / path.name):
            same = os.path.exists(found) and os.path.exists(where) and found.samefile(where)
            if same or found == where or where in found.parents:
                raise ResultError(f"{output}: {path} is read from there: choose another {option}")


def files_read(result: Path) -> list[Path]:
    """The files that a command may read from a result folder or a recording, or writes to one."""
    names = (RECORDING_NAME, CONFIG_NAME, *_RIGID_FILES, *SOMETIMES, *MESH_FILES, SURFELS_NAME)
    return [*parts.parts_of(result), *(result / name for name in names)]


@contextmanager
def all_or_none(output: Path) -> Generator[Path]:
    """A folder whose files all move into ``output`` at its end, or none if the disk is full.

    Raises ResultError.
    """
    try:
        with staging(output) as folder:
            made = folder / "results"
            made.mkdir()
            yield made
            _switch(made, output)
    except OSError as error:
        raise ResultError(
            f"{output}: cannot write the results ({error.strerror}); the recording is kept"
        ) from None


def _switch(made: Path, output: Path) -> None:
    """Put all files in place atomically: after a kill, the next holder of the folder completes it.
    Raises OSError."""
    for path in made.iterdir():
        if is_folder(output / path.name):
            raise IsADirectoryError(errno.EISDIR, f"{path.name} is a folder")
    sync_all(made)
    made.rename(output / _SWITCHING)
    sync(output)
    _finish_switch(output)


def replace_by(output: Path, made: Path) -> None:
    """Replace a result by another one, whole, in a folder on the same file system
    without a holder; after a kill, the next holder completes it.  Raises ResultError."""
    try:
        sync_all(made)
        made.rename(output / _SWITCHING)
        sync(output)
        _finish_switch(output)
    except OSError as error:
        raise _unwritable(output, error) from None


def _finish_switch(output: Path) -> None:
    """Raises OSError."""
    new = output / _SWITCHING
    if not is_folder(new):
        return
    if (new / RECORDING_NAME).exists():  # of another run: nothing of the one before stays
        earlier.remove(output, _result_in(output))
        (new / RECORDING_NAME).rename(output / RECORDING_NAME)
        sync(output)
    move_all(new, output)
    new.rmdir()


@contextmanager
def written(output: Path, *, force: bool) -> Generator[Held]:
    """Hold a result folder while results are written to it; a new one is deleted if it stays empty.

    Raises ResultError if the results cannot go there, or another process is writing them.
    """
    check_output(output, force=force)
    missing = [folder for folder in (output, *output.parents) if not folder.exists()]
    try:
        try:
            make_folder(output)
            held_folder = Held(output)
        except OSError as error:
            raise _unwritable(output, error) from None
        try:
            check_output(output, force=force)  # another one may have been here meanwhile
            _settle(output)
            yield held_folder
        finally:
            try:
                with suppress(PliantError):  # the next writer reports it
                    now = held_folder.path  # perhaps it has another name now
                    if now is not None:
                        _settle(now)
            finally:
                held_folder.release()
    finally:
        for folder in missing:
            with suppress(OSError):
                folder.rmdir()


@contextmanager
def recorded_into(folder: Path) -> Generator[None]:
    """Hold the folder of a recording against those who would replace what is there.

    Others may record into it beside us.  Raises ResultError if results are written to it.
    """
    settle_killed(folder)
    try:
        make_folder(folder)
        held_folder = Held(folder, fcntl.LOCK_SH)
    except OSError as error:
        raise _unwritable(folder, error) from None
    try:
        yield
    finally:
        held_folder.release()


def is_being_written(output: Path) -> bool:
    """Whether another process holds a result folder, perhaps on another machine."""
    return holder_of(output) is not None


def check_free(*folders: Path, elsewhere: bool = True) -> None:
    """Raise ResultError if another process writes to one of these folders.

    elsewhere: whether the command has an --output that can name another one.
    """
    for folder in folders:
        holder = holder_of(folder)
        if holder is not None:
            raise held(folder, holder, elsewhere=elsewhere)
        if is_folder(folder / _SWITCHING):
            settle_killed(folder)


def check_output(output: Path, *, force: bool) -> None:
    """Raise ResultError if the results cannot go there.  Changes nothing."""
    try:
        if output.exists() and not output.is_dir():
            raise ResultError(f"{output} is a file: choose another --output")
        there = {each.name for each in output.iterdir()} if output.is_dir() else set[str]()
        if there - {LOCK_NAME} and not force:
            raise ResultError(
                f"{output} exists: choose another --output, or --force to overwrite it"
            )
        parent = next(folder for folder in (output, *output.parents) if folder.exists())
    except OSError as error:
        raise _unwritable(output, error) from None
    if not parent.is_dir():
        raise ResultError(f"{output}: {parent} is a file: choose another --output")
    if not os.access(parent, os.W_OK | os.X_OK):
        raise ResultError(f"{output}: {parent} is not writable: choose another --output")


def prepare(output: Path, config: str) -> None:
    """Make the folder, with what the services read.

    An earlier result is set aside until the new one has frames; `written` puts it back if there are
    none in the end.  Raises ResultError.
    """
    folder = parts.folder_of_parts(output / RECORDING_NAME)
    if folder.is_symlink() and parts.parts_in(folder):
        raise ResultError(
            f"{folder} is a link to a folder with a recording: move the recording, or remove the "
            "link"
        )
    try:
        if (output / _LOGS).is_symlink():  # what it points to is not ours
            (output / _LOGS).unlink()
        make_folder(output / _LOGS)
        earlier.set_aside(output, _result_in(output))
        write_whole(output / CONFIG_NAME, config)
        write_whole(output / _LOGS / _METADATA, json.dumps(run_metadata(config)))
    except OSError as error:
        raise _unwritable(output, error) from None


def settle_killed(output: Path) -> None:
    """Decide which result a folder keeps after the process that was to replace it was killed.

    Raises PliantError.
    """
    if earlier.is_aside(output) or earlier.is_moving(output) or is_folder(output / _SWITCHING):
        with written(output, force=True):
            pass


def let_go(output: Path) -> None:
    """Delete the earlier result, once the recording of the new one is on disk.

    Raises ResultError.
    """
    try:
        for part in parts.parts_of(output / RECORDING_NAME):
            sync(part)
        earlier.replace(output)
    except OSError as error:
        raise _unwritable(output, error) from None


def _settle(output: Path) -> None:
    """If an earlier result is set aside: delete it if the new one has frames, otherwise put it
    back.

    Logs are those of the last run in any case.  The caller holds the folder exclusively: files that
    killed processes left are deleted.  Raises PliantError, and then has deleted nothing.
    """
    try:
        clear_staging(output)
        _finish_switch(output)
        (output / SESSION_NAME).unlink(missing_ok=True)
        if earlier.is_moving(output):
            earlier.move_back(output)
        if earlier.is_aside(output):
            if has_frames(output):
                let_go(output)
            else:
                earlier.put_back(output, _begun_in(output))
        earlier.clear(output)
    except OSError as error:
        raise _unwritable(output, error) from None


def has_frames(output: Path) -> bool:
    """Whether data of any frame is recorded, from which results can be made even if it is damaged.

    Raises RecordingError if that cannot be known.
    """
    for part in parts.parts_of(output / RECORDING_NAME):
        with suppress(NothingReadableError):
            found = Recording(part).everything(*_OF_FRAMES)
            if any(isinstance(item, Recorded) and item.checked for item in found):
                return True
    return False


def _result_in(output: Path) -> Iterator[Path]:
    """The existing files and folders of a result, without exports and logs."""
    yield from _begun_in(output)
    files = {*_RIGID_FILES, *SOMETIMES, *MESH_FILES, SURFELS_NAME}
    for path in sorted(output.iterdir()):
        if not path.is_dir() and _OF_SEGMENT.sub("", path.name) in files:
            yield path


def _begun_in(output: Path) -> Iterator[Path]:
    """Files that a run without a frame may have written."""
    folder = parts.folder_of_parts(output / RECORDING_NAME)
    found = parts.parts_in(folder)
    yield from found
    if folder.is_dir() and not folder.is_symlink() and not found and not any(folder.iterdir()):
        yield folder
    for name in (RECORDING_NAME, CONFIG_NAME, SESSION_NAME, STATE_FOLDER):
        if os.path.lexists(output / name):
            yield output / name


def discard(output: Path, logs: Iterable[str]) -> None:
    """Delete all files of a run without a recorded frame, and logs of these names.

    An earlier result that is set aside is put back, with the logs of the last run.
    """
    if earlier.is_aside(output):
        return
    made = [output / _LOGS / name for name in (*logs, _METADATA)]
    with suppress(OSError):
        earlier.remove(output, [*_begun_in(output), *made])


def _unwritable(output: Path, error: OSError) -> ResultError:
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return ResultError(
            f"{output}: the disk is full: free some space or choose another --output"
        )
    return ResultError(f"{output}: cannot be written ({error.strerror}): choose another --output")


def run_metadata(config: str) -> dict[str, dict[str, str]]:
    """The metadata of a recording: how it was made."""
    return {
        "pliant": {
            "version": __version__,
            "commit": commit_of(Path(__file__).parents[1]),
            "command": " ".join(sys.argv),
            "python": platform.python_version(),
            "host": platform.node(),
            "machine": f"{platform.system()} {platform.machine()}",
            "cpu_count": str(os.cpu_count()),
        },
        "arithmetic": {"target": target()},
        "packages": {name: version(name) for name in _VERSIONS},
        "config": {"yaml": config},
    }


def commit_of(package: Path) -> str:
    """The commit of the checkout that a package is run from; "" for one that is installed.

    It may be installed inside the checkout of another project.
    """
    git = ("git", "-C", package)
    own = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}

    def output_of(*arguments: str) -> str:
        command = [*git, *arguments]
        done = subprocess.run(command, capture_output=True, text=True, timeout=5, env=own)
        return done.stdout.strip() if done.returncode == 0 else ""

    try:
        tracked = output_of("ls-files", "--full-name", "__init__.py")
        return output_of("rev-parse", "HEAD") if tracked == "shared/pliant/__init__.py" else ""
    except (OSError, subprocess.SubprocessError):
        return ""


def files_of(output: Path, report: dict[str, Any]) -> list[str]:
    """Names of the files of a run with this report, except its recording."""
    if report.get("profile") == "deformable":
        always, sometimes = SURFEL_FILES, (ONLINE_NAME, *SOMETIMES)
    else:
        always, sometimes = _RIGID_FILES, (*SOMETIMES, *MESH_FILES)
    return [*always, *(name for name in sometimes if (output / name).exists())]
