"""What the map is worth that knows its places: sources with them and without, lit and cut."""

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.table import markdown_header, markdown_row
from pliant.algorithms.arrays import F64
from pliant.algorithms.geometry import align_umeyama
from pliant.algorithms.mapping.known_places import KnownPlaces
from pliant.algorithms.mapping.loops import Loop
from pliant.algorithms.mapping.mapper import Mapper
from pliant.algorithms.mapping.trial import mapper_for
from pliant.algorithms.tracking.tracker import ExtremaTracker
from pliant.config import Config
from pliant.datasets import open_source
from pliant.datasets.rectifier import Rectifier, rectified
from pliant.evaluation.report import metres
from pliant.formats.trajectory_files import read_trajectory
from pliant.map_history import MapHistory
from pliant.trajectory import associate

_DARK_S = 2.0
_HEADER = ("source", "places", "ATE final", "causal", "poses", "segments", "CPU a frame")


class _NoPlaces(KnownPlaces):
    """Nothing is ever remembered or recognised."""

    def recognise(self, *_: object, **__: object) -> None:
        return None

    def compare(self, *_: object, **__: object) -> list[Loop]:
        return []

    def remember(self, *_: object, **__: object) -> None:
        return None


@dataclass
class _Seen:
    """ATE, metres, of the longest segment at the end, and of the longest one as it was known then.
    share: of the lit frames that have a pose in the longest segment.   cpu_ms: a frame."""

    final_m: float
    causal_m: float
    share: float
    segments: int
    cpu_ms: float

    def cells(self) -> tuple[str, ...]:
        share = f"{100.0 * self.share:.1f} %"
        ate = metres(self.final_m), metres(self.causal_m)
        return *ate, share, str(self.segments), f"{self.cpu_ms:.0f} ms"


def _run(name: str, config: Config, *, places: bool, cut: bool) -> _Seen:
    """cut: it is dark for a while in the middle, and the camera moves on meanwhile."""
    dataset = open_source(name)
    rectifier = Rectifier(dataset.calibration)
    camera = rectifier.camera
    stamps_ns = np.array([frame.stamp_ns for frame in dataset], np.int64)
    middle = stamps_ns[len(stamps_ns) // 2]
    dark = (stamps_ns >= middle) & (stamps_ns < middle + 1e9 * _DARK_S) & cut
    tracker = ExtremaTracker(camera.width, camera.height, config.tracking, config.seed)
    mapper = mapper_for(
        camera, config.bundle_adjustment, config.seed, dataset.calibration.focal_sigma
    )
    assert isinstance(mapper, Mapper), "a camera whose calibration is known"
    if not places:
        mapper.atlas.places = _NoPlaces()
    history, spent = MapHistory(), 0.0
    for number, source in enumerate(dataset):
        image = rectified(source, rectifier)
        if dark[number]:
            nothing = np.zeros_like(image.grey), np.zeros_like(image.colour)
            image = replace(image, grey=nothing[0], colour=nothing[1])
        colour = image.colour if image.colour.size else None
        begin = time.process_time()
        tracks = tracker.track(image.grey)
        delta = mapper.process(number, image.stamp_ns, tracks, image.grey, colour)
        mapper.publish_keyframes()
        spent += time.process_time() - begin
        history.apply(delta, frame=number, stamp_ns=image.stamp_ns)
    history.apply(mapper.finish(), frame=len(dark) - 1, stamp_ns=0, final=True)
    assert dataset.ground_truth_path is not None
    truth = read_trajectory(Path(dataset.ground_truth_path))
    mine, true = associate(stamps_ns, truth.stamps_ns)
    positions = dict(zip(mine.tolist(), truth.positions[true], strict=True))
    final = history.final()
    return _Seen(
        final_m=_ate_m(final, positions),
        causal_m=_ate_m(history.causal, positions),
        share=len(_longest(final)) / int((~dark).sum()),
        segments=len({segment for segment, _ in final.values()}),
        cpu_ms=1e3 * spent / len(dark),
    )


def _longest(poses: dict[int, tuple[int, F64]]) -> dict[int, F64]:
    """Poses of the segment that has most of them."""
    count: dict[int, int] = {}
    for segment, _ in poses.values():
        count[segment] = count.get(segment, 0) + 1
    longest = max(count, key=count.__getitem__, default=-1)
    return {frame: pose for frame, (segment, pose) in poses.items() if segment == longest}


def _ate_m(poses: dict[int, tuple[int, F64]], truth: dict[int, F64]) -> float:
    chosen = _longest(poses)
    frames = sorted(frame for frame in chosen if frame in truth)
    mine = np.array([chosen[frame][:3] for frame in frames])
    true = np.array([truth[frame] for frame in frames])
    scale, R, t = align_umeyama(mine, true, with_scale=True)
    return float(np.sqrt(((scale * mine @ R.T + t - true) ** 2).sum(axis=1).mean()))


def measure(sources: list[str], config: Config) -> Iterator[str]:
    """Four rows for each source: as it is and cut, with places and without."""
    yield markdown_header(_HEADER)
    for name in sources:
        for cut in (False, True):
            title = Path(name).name + (f", {_DARK_S:.0f} s dark" if cut else "")
            for places in (True, False):
                seen = _run(name, config, places=places, cut=cut)
                yield markdown_row((title, "on" if places else "off", *seen.cells()))
