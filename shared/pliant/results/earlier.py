"""An earlier result stays in its folder until the result that replaces it has a frame.

The names of folders show its progress, so that it may be interrupted at any point, by a kill or a
power cut, without loss: ``earlier_result.half`` while entries move, either way;
``earlier_result.pliant`` once all are aside: what lies beside it is new, and this is a result that
can be opened; ``.pliant-replaced-*`` once it has been replaced.
"""

import os
import shutil
import tempfile
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from pliant.files import make_folder, sync

_HALF, _WHOLE, _REPLACED = "earlier_result.half", "earlier_result.pliant", ".pliant-replaced-"


def set_aside(output: Path, entries: Iterable[Path]) -> None:
    """Move files and folders of a result out of the way, if there are any.  Raises OSError."""
    half, entries = output / _HALF, list(entries)
    _move(entries, output, half)
    _clear_folders(entries, output)
    if half.is_dir():
        half.rename(output / _WHOLE)
        sync(output)


def is_aside(output: Path) -> bool:
    """Whether there is a result that is set aside, and neither replaced nor put back."""
    whole = output / _WHOLE
    return whole.is_dir() and any(whole.iterdir())  # a user may have put it back


def is_moving(output: Path) -> bool:
    """Whether moving a result aside or back was interrupted."""
    return (output / _HALF).is_dir()


def replace(output: Path) -> None:
    """Mark what is set aside as replaced: another result has begun.  Raises OSError."""
    # Into a folder of its own: one that could not be emptied may be there still.
    (output / _WHOLE).rename(Path(tempfile.mkdtemp(prefix=_REPLACED, dir=output)) / _WHOLE)
    sync(output)
    clear(output)


def clear(output: Path) -> None:
    """Delete what has been replaced, as far as possible, and empty folders."""
    for name in (_HALF, _WHOLE):
        with suppress(OSError):
            (output / name).rmdir()
    for replaced in output.glob(f"{_REPLACED}*"):
        shutil.rmtree(replaced, ignore_errors=True)


def put_back(output: Path, new: Iterable[Path]) -> None:
    """Put what is set aside where it was.  Raises OSError.

    new: the entries beside it, which are deleted.
    """
    remove(output, new)
    (output / _WHOLE).rename(output / _HALF)
    sync(output)
    move_back(output)


def move_back(output: Path) -> None:
    """Put back what was moving.  Raises OSError."""
    half = output / _HALF
    # A folder that is there has what was not of the result.
    for folder in [path for path in half.iterdir() if _is_folder(output / path.name)]:
        _move(folder.iterdir(), half, output)
        folder.rmdir()
    _move(half.iterdir(), half, output)
    half.rmdir()
    sync(output)


def remove(output: Path, entries: Iterable[Path]) -> None:
    """Delete files, links, and folders with all that is in them, of a result.  Raises OSError."""
    entries = list(entries)
    for path in entries:
        if _is_folder(path):
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
    _clear_folders(entries, output)


def _clear_folders(entries: Iterable[Path], output: Path) -> None:
    """Delete the folders inside the result's that have become empty."""
    for folder in {entry.parent for entry in entries} - {output}:
        with suppress(OSError):
            folder.rmdir()


def _move(entries: Iterable[Path], source: Path, target: Path) -> None:
    """Move what lies in one folder to the same place in another, which is on the disk then."""
    moves = [(path, target / path.relative_to(source)) for path in entries]
    for folder in sorted({to.parent for _, to in moves}):
        make_folder(folder)
    for path, to in moves:
        path.rename(to)
    for folder in sorted({each.parent for move in moves for each in reversed(move)}):
        sync(folder)


def _is_folder(path: Path) -> bool:
    return path.is_dir() and not os.path.islink(path)
