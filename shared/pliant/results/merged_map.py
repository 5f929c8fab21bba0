"""Merges two map files into one."""

from collections.abc import Iterator
from pathlib import Path

from pliant.algorithms.slam.atlas.merging import Merged, merge
from pliant.config import load_config
from pliant.errors import MapError
from pliant.files import make_folder
from pliant.messages.types import WORLD_FRAME_ID, Header, MapKeyframe
from pliant.recording.map_file import MapFile, MapHeader, write_map
from pliant.results.folder import keep_apart
from pliant.wording import counted


def merge_maps(first: Path, second: Path, output: Path, *, force: bool) -> Iterator[str]:
    """Merge two maps that show the same places into one file, and describe it in a few lines.

    first, second: result folders or map files.   output: a file.   Raises MapError and ResultError,
    and then has written nothing: for an invalid map, without a common place, for an output that is
    also an input, and for an existing one unless ``force``.
    """
    files = MapFile(first), MapFile(second)
    keep_apart(output, [file.path for file in files])
    if output.is_dir():
        raise MapError(f"{output} is a folder: name a file, such as {output / 'map.pliant'}")
    if output.exists() and not force:
        raise MapError(f"{output} exists: choose another --output, or --force to replace it")
    if files[0].path.resolve() == files[1].path.resolve():
        raise MapError(f"{second}: is the same map as the first: pass two different maps")
    known, other = (list(file.keyframes()) for file in files)
    parameters = load_config().bundle_adjustment
    try:
        merged = merge(known, other, parameters)
    except ValueError as error:
        raise MapError(f"{first} and {second}: damaged: {error}") from None
    if merged is None:
        raise MapError(
            f"{second}: none of its {counted(len(other), 'keyframe')} shows a place of {first}: "
            "nothing is written; film both places in one run with --map to merge them"
        )
    first_header = files[0].header
    header = MapHeader(
        source=files[1].header.source,
        calibration=first_header.calibration,
        metric=first_header.metric,
        level=first_header.level,
    )
    try:
        make_folder(output.parent)
    except OSError as error:
        raise MapError(f"{output}: the map cannot be written: {error.strerror}") from None
    write_map(output, header, _messages(merged))
    yield from _summary(merged, second, output)


def _messages(merged: Merged) -> Iterator[MapKeyframe]:
    for number, keyframe in enumerate(merged.keyframes):
        header = Header(frame=number, stamp_ns=0, frame_id=WORLD_FRAME_ID)
        yield MapKeyframe.of(header, keyframe)


def _summary(merged: Merged, second: Path, output: Path) -> Iterator[str]:
    points = sum(len(each.point_ids) for each in merged.keyframes)
    yield f"{output}: {counted(len(merged.keyframes), 'keyframe')}, {counted(points, 'point')}"
    for old, segment in merged.joined:
        yield f"segment {old} of {second} is now part of segment {segment}"
    for old, segment in merged.apart:
        yield f"segment {old} of {second} shows no place of the other map: it is segment {segment}"
    shows = "pair of keyframes shows" if merged.proofs == 1 else "pairs of keyframes show"
    yield f"{merged.proofs} {shows} the same place"
