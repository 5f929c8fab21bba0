"""Lists of images and their times, and lists of times alone.

"time file" a line, separated by spaces, tabs, commas or semicolons; # for comments
"time file time file": an association of colour and depth images, as the TUM benchmark's tools
write it
"""

import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from decimal import Decimal, InvalidOperation
from pathlib import Path

from pliant.datasets.frame_times import increasing, why_wrong
from pliant.datasets.images import ListedImage, image_files
from pliant.datasets.times import likely_unit, nanoseconds, number_of, rate
from pliant.errors import DatasetError
from pliant.text_files import decoded
from pliant.wording import counted, shortened, shown

_LINE = re.compile(r"([^\s,;]+)[\s,;]+(\S.*)")
_PAIR = re.compile(r"(\S.*?)[\s,;]+([0-9.eE+-]+)[\s,;]+(\S.*)")
_MAX_WRONG = 0.1
"""With a larger share of times that do not increase or missing files, the list itself is wrong."""


@dataclass
class ImageList:
    """The lines of a list.   others: of an association, the second file of each line.

    notes: what a user should know of it, in lines.
    """

    images: list[ListedImage]
    others: list[Path] = field(default_factory=list[Path])
    notes: list[str] = field(default_factory=list[str])


def data_lines(file: Path) -> Iterator[tuple[int, str]]:
    """(number from 1, text) of the lines of a list that are neither empty nor comments."""
    try:
        text = decoded(file.read_bytes())
    except FileNotFoundError:
        raise DatasetError(f"{file}: missing; every image needs its time stamp there") from None
    except UnicodeDecodeError:
        raise DatasetError(f"{file}: is not a text file") from None
    except OSError as error:
        raise DatasetError(f"{file}: cannot be read: {error.strerror}") from None
    for number, line in enumerate(text.splitlines(), start=1):
        line = line.strip()
        if line and not line.startswith("#"):
            yield number, line


def read_list(file: Path, folder: Path, *, unit: str = "seconds") -> ImageList:
    """Read a list of images; files are relative to ``folder``.

    unit: of its times; where another one is far more likely, it is used, with a note.
    A few times that do not increase cost their images, see ``mended``.
    Raises DatasetError, with the number of the line, for files that are not there or not in the
    folder, and lines that are something else.
    """
    rows = list(_rows(file, folder))
    if not rows:
        raise DatasetError(f"{file}: lists no images")
    missing = [row for row in rows if not row.path.is_file()]
    if len(missing) > _MAX_WRONG * len(rows):
        raise DatasetError(
            f"{file}: line {missing[0].line}: no file {shortened(missing[0].name)} in {folder} "
            f"({len(missing)} of {len(rows)} listed images are missing); bring them back or "
            "remove their lines"
        )
    stamps, notes = stamps_of([(row.line, row.time) for row in rows], file, unit)
    images = [ListedImage(stamp_ns=t, path=row.path) for t, row in zip(stamps, rows, strict=True)]
    images, more_notes = mended(images, [row.line for row in rows], file)
    if missing:
        of = f"{counted(len(missing), 'file')} of {len(rows)}"
        more_notes.append(
            f"{file.name}: {of} (the first in line {missing[0].line}) are missing and count "
            "as broken"
        )
    others = [row.other for row in rows if row.other is not None]
    return ImageList(
        images,
        others if len(others) == len(rows) else [],
        [*notes, *more_notes, *_unlisted(file, rows)],
    )


def _unlisted(file: Path, rows: "Sequence[_Row]") -> list[str]:
    """A note where the folders of the listed images hold others."""
    listed = {row.path for row in rows}
    folders = {path.parent for path in listed}
    there = {path for folder in folders if folder.is_dir() for path in image_files(folder)}
    others = {path for row in rows if (path := row.other) is not None}
    left = len(there - listed - others)
    if not left:
        return []
    names = ", ".join(sorted({f"{folder.name}/" for folder in folders})[:3])
    return [f"{file.name}: lists {len(listed)} images; {left} more in {names} are skipped"]


def stamps_of(
    lines: Sequence[tuple[int, str]], file: Path, unit: str
) -> tuple[list[int], list[str]]:
    """Nanoseconds of the times in lines (number, text), and a note where the unit is another.

    Raises DatasetError.
    """
    values = [number_of(text, f"{file}: line {line}") for line, text in lines]
    likely = likely_unit(values, unit)
    stamps = [
        nanoseconds(value, likely, f"{file}: line {line}")
        for value, (line, _) in zip(values, lines, strict=True)
    ]
    notes = [f"{file.name}: times are taken as {likely}, not {unit}: {rate(stamps)}"]
    return stamps, notes if likely != unit else []


def mended(
    images: Sequence[ListedImage], lines: Sequence[int], file: Path
) -> tuple[list[ListedImage], list[str]]:
    """The images with increasing times, and a note where some did not increase.

    Those become broken frames between the others.  Raises DatasetError if they are many.
    """
    stamps = [image.stamp_ns for image in images]
    good = set(increasing(stamps))
    wrong = len(stamps) - len(good)
    if not wrong:
        return list(images), []
    if wrong > _MAX_WRONG * len(stamps):
        _refuse(stamps, lines, file)
    found, waiting, last_ns, step_ns = list(images), list[int](), -1, 1
    for row in [*range(len(images)), -1]:
        if row >= 0 and (row not in good or stamps[row] - last_ns <= len(waiting)):
            waiting.append(row)
            continue
        if row >= 0:
            step_ns = (stamps[row] - last_ns) // (len(waiting) + 1)
        for number, each in enumerate(waiting, start=1):
            between_ns = last_ns + number * step_ns
            found[each] = replace(images[each], stamp_ns=between_ns, fault=why_wrong(stamps[each]))
        last_ns, waiting = stamps[row], []
    first = next(row for row in range(len(stamps)) if found[row].fault)
    more_notes = (
        f"{file.name}: the times of {counted(wrong, 'image')} do not increase (the first in line "
        f"{lines[first]}), and count as broken"
    )
    return found, [more_notes]


def inside(folder: Path, name: str, where: str) -> Path:
    """The path of a listed file.  Raises DatasetError if it would leave the folder."""
    normal = os.path.normpath(name)
    if "\0" in name or os.path.isabs(name) or normal.split(os.sep)[0] == "..":
        raise DatasetError(
            f"{where}: {shown(name)} is outside of {folder}; list only files inside it"
        )
    return folder / normal


@dataclass(frozen=True)
class _Row:
    line: int
    time: str
    name: str
    path: Path
    other: Path | None = None


def _rows(file: Path, folder: Path) -> Iterator[_Row]:
    for number, (line, text) in enumerate(data_lines(file)):
        where = f"{file}: line {line}"
        match = _LINE.fullmatch(text)
        if match is None:
            raise DatasetError(f'{where}: expected "time file", got {shown(text)}')
        if number == 0 and not _is_number(match.group(1)) and re.match("[#A-Za-z]*time", text):
            continue  # the header of a table
        name = _unquoted(match.group(2))
        path, pair = inside(folder, name, where), _PAIR.fullmatch(match.group(2))
        if pair is None or path.is_file() or not _is_number(pair.group(2)):
            yield _Row(line, match.group(1), name, path)
            continue
        names = [_unquoted(pair.group(1)), _unquoted(pair.group(3))]
        times = [match.group(1), pair.group(2)]
        if "depth" in names[0].lower() and "depth" not in names[1].lower():
            names, times = names[::-1], times[::-1]
        first, second = (inside(folder, each, where) for each in names)
        yield _Row(line, times[0], names[0], first, second)


def _unquoted(name: str) -> str:
    return name.strip().strip('"')


def _is_number(text: str) -> bool:
    try:
        return Decimal(text).is_finite()
    except InvalidOperation:
        return False


def _refuse(stamps_ns: Sequence[int], lines: Sequence[int], file: Path) -> None:
    """Raise DatasetError at the first time that repeats or runs backwards."""
    i = next(i for i in range(1, len(stamps_ns)) if stamps_ns[i] <= stamps_ns[i - 1])
    what = "repeats" if stamps_ns[i] == stamps_ns[i - 1] else "runs backwards from"
    before, here = _seconds(stamps_ns[i - 1]), _seconds(stamps_ns[i])
    raise DatasetError(
        f"{file}: line {lines[i]}: the time {here} s {what} that of line {lines[i - 1]} ({before} "
        "s); sort the list and remove duplicates"
    )


def _seconds(stamp_ns: int) -> str:
    return f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d}"
