"""Two sessions over parts of a source that overlap, mapped by themselves, and merged into one."""

import time
from collections.abc import Iterator

from benchmarks.kept_maps import Source, through_file
from benchmarks.table import markdown_header, markdown_row
from pliant.algorithms.slam.atlas.merging import merge
from pliant.algorithms.slam.map.kept_keyframe import KeptKeyframe
from pliant.algorithms.slam.mapper import Mapper
from pliant.config import Config

_ENDS, _BEGINS = 0.6, 0.4
_HEADER = (
    *("source", "keyframes", "points", "pairs", "CPU", "ATE of the first", "of the second"),
    *("merged", "uncut"),
)


def measure(sources: list[str], config: Config) -> Iterator[str]:
    """A row for each source, whose frames have true poses; errors are those of keyframes."""
    yield markdown_header(_HEADER)
    for name in sources:
        yield markdown_row(_row(name, Source(name, config), config))


def _row(name: str, source: Source, config: Config) -> tuple[str, ...]:
    count = len(source.stamps_ns)
    parts = range(round(_ENDS * count)), range(round(_BEGINS * count), count)
    first, second = (_kept(source, part) for part in parts)
    begin = time.process_time()
    merged = merge(first, second, config.bundle_adjustment)
    spent = time.process_time() - begin
    uncut = _kept(source, range(count))
    ates = [_ate_mm(source, kept) for kept in (first, second)]
    if merged is None:
        cells = "-", "-", f"{spent:.1f} s", *ates, "not recognised"
    else:
        both = merged.keyframes
        points = " + ".join(f"{_points(kept):,}" for kept in (first, second))
        cells = (
            f"{points}: {_points(both):,}", str(merged.proofs), f"{spent:.1f} s", *ates,
            _ate_mm(source, both),
        )  # fmt: skip
    keyframes = f"{len(first)} + {len(second)}"
    return name.rsplit("/", 1)[-1], keyframes, *cells, _ate_mm(source, uncut)


def _kept(source: Source, frames: range) -> list[KeptKeyframe]:
    mapper = source.run(frames).mapper
    assert isinstance(mapper, Mapper)
    return list(through_file(mapper)[2])


def _points(kept: list[KeptKeyframe]) -> int:
    return sum(len(each.point_ids) for each in kept)


def _ate_mm(source: Source, kept: list[KeptKeyframe]) -> str:
    """Of the keyframes of all sessions in the first segment, under one alignment."""
    poses = [(k.source_frame, k.T_world_camera) for k in kept if k.segment == kept[0].segment]
    return f"{source.ate_mm(poses):.2f} mm"
