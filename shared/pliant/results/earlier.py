"""An earlier result stays where it was until the one that replaces it has its first frame.

Folders within the result's tell how far that came, so that it can end at any point, by a kill or a
power cut, and nothing is lost: ``.half`` while files move, either way; ``.earlier`` once all are
aside, so that what lies beside it is new; ``.replaced`` once they are not wanted any more.
"""

import shutil
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from pliant.files import make_folder, sync

_HALF, _WHOLE, _REPLACED = ".half", ".earlier", ".replaced"


def set_aside(output: Path, paths: Iterable[Path]) -> None:
    """Move files and folders of a result out of the way.  Raises OSError."""
    half = output / _HALF
    _move(paths, output, half)
    if half.exists():
        half.rename(output / _WHOLE)
        sync(output)


def replace(output: Path) -> None:
    """Let go of what was set aside: another result has begun.  Does nothing where nothing is."""
    aside, replaced = output / _WHOLE, output / _REPLACED
    if aside.exists():
        with suppress(OSError):
            aside.rename(replaced)
            sync(output)
    if replaced.exists():
        shutil.rmtree(replaced, ignore_errors=True)


def is_aside(output: Path) -> bool:
    """Whether there is a result that comes back unless it is replaced."""
    return (output / _WHOLE).exists()


def put_back(output: Path, new: Iterable[Path]) -> bool:
    """Put what was set aside and not replaced where it was; whether there was any.

    new: what lies beside it, and goes then; it is asked for in that case only.
    Raises OSError.
    """
    aside, half = output / _WHOLE, output / _HALF
    if aside.exists():
        for path in new:
            remove(path)
        aside.rename(half)
        sync(output)
    if not half.exists():
        return False
    _move([path for path in half.rglob("*") if not path.is_dir()], half, output)
    shutil.rmtree(half)
    return True


def _move(paths: Iterable[Path], source: Path, target: Path) -> None:
    """Move what lies in one folder to the same place in another, which is on the disk then."""
    moves = [(path, target / path.relative_to(source)) for path in paths]
    for folder in sorted({to.parent for _, to in moves}):
        make_folder(folder)
    for path, to in moves:
        path.rename(to)
    for folder in sorted({each.parent for move in moves for each in reversed(move)}):
        sync(folder)


def remove(path: Path) -> None:
    """Delete a file, or a folder with all that is in it.  Raises OSError."""
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
