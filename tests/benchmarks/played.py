"""A sequence whose frames are shown in any order: what comes of it, with places and without."""

import time
from collections import Counter
from collections.abc import Sequence, Set
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.geometry import align_umeyama
from pliant.algorithms.slam.adjust.loops import Loop
from pliant.algorithms.slam.atlas.known_places import KnownPlaces
from pliant.algorithms.slam.calibration_bootstrap import mapper_for
from pliant.algorithms.slam.frame import Frame
from pliant.algorithms.slam.mapper import Mapper
from pliant.algorithms.tracking.tracker import ExtremaTracker
from pliant.config import Config
from pliant.datasets import open_source
from pliant.datasets.rectifier import Rectifier, rectified
from pliant.formats.trajectory_files import read_trajectory
from pliant.map_history import MapHistory
from pliant.trajectory import associate

DARK = -1
"""Shown instead of a frame."""


class _NoPlaces(KnownPlaces):
    """Nothing is ever remembered or recognised."""

    def recognise(self, *_: object, **__: object) -> None:
        return None

    def compare(self, *_: object, **__: object) -> list[Loop]:
        return []

    def remember(self, *_: object, **__: object) -> None:
        return None


@dataclass(frozen=True, kw_only=True)
class Played:
    """What came of it; everything by number of the image that was shown.

    final: (7,) poses of the segment that has most of them in the end.   online: likewise, as they
    were known when the image had come.   truth: (3,) positions.   lit: images that were not dark.
    joined: when segments became one.   same_places: pairs of keyframes that were found to show one
    place.   compared: what came of comparing keyframes, see ``Comparisons``.   cpu_ms: an image.
    """

    final: dict[int, F64]
    online: dict[int, F64]
    truth: dict[int, F64]
    lit: int
    segments: int
    joined: list[int]
    same_places: int
    compared: dict[str, int]
    cpu_ms: float

    @property
    def share(self) -> str:
        """Of the lit images, those that have a pose in the longest segment."""
        return f"{100.0 * len(self.final) / self.lit:.1f} %"

    def errors_m(
        self, poses: dict[int, F64], of: Set[int] | None = None, *, by: int | None = None
    ) -> F64:
        """Of poses, after the Sim(3) that aligns them, or the first ``by``.   of: these alone."""
        chosen = sorted(poses.keys() & self.truth.keys() & (poses.keys() if of is None else of))
        mine = np.array([poses[n][:3] for n in chosen])
        true = np.array([self.truth[n] for n in chosen])
        scale, R, t = align_umeyama(mine[:by], true[:by], with_scale=True)
        return np.linalg.norm(scale * mine @ R.T + t - true, axis=1)

    def ate_m(self, poses: dict[int, F64], of: Set[int] | None = None) -> float:
        """Of poses, after the Sim(3) that aligns them.   of: these alone."""
        return float(np.sqrt((self.errors_m(poses, of) ** 2).mean()))


class Reel:
    """A sequence that has true poses."""

    def __init__(self, name: str, config: Config) -> None:
        self._config = config
        dataset = open_source(name)
        self._calibration = dataset.calibration
        self._frames = list(dataset)
        self.stamps_ns = np.array([frame.stamp_ns for frame in self._frames], np.int64)
        assert dataset.ground_truth_path is not None
        truth = read_trajectory(Path(dataset.ground_truth_path))
        mine, true = associate(self.stamps_ns, truth.stamps_ns)
        self._truth = dict(zip(mine.tolist(), truth.positions[true], strict=True))
        self.step_ns = int(np.median(np.diff(self.stamps_ns)))

    def __len__(self) -> int:
        return len(self._frames)

    def night(self, seconds: float) -> list[int]:
        """So long in the dark."""
        return [DARK] * round(1e9 * seconds / self.step_ns)

    def play(self, order: Sequence[int], *, places: bool = True) -> Played:
        """Show frames, by their numbers, and the dark.

        At the sequence's rate; at its own times where it goes on and on.   places: whether the map
        knows its places.
        """
        rectifier, config = Rectifier(self._calibration), self._config
        camera = rectifier.camera
        tracker = ExtremaTracker(camera.width, camera.height, config.tracking, config.seed)
        mapper = mapper_for(
            camera, config.bundle_adjustment, config.seed, self._calibration.focal_sigma
        )
        assert isinstance(mapper, Mapper), "a camera whose calibration is known"
        if not places:
            mapper.atlas.places = _NoPlaces()
        history, joined, spent = MapHistory(), list[int](), 0.0
        on_and_on = all(source in (DARK, n) for n, source in enumerate(order))
        for number, source in enumerate(order):
            image = rectified(self._frames[max(source, 0)], rectifier)
            if source == DARK:
                dark = np.zeros_like(image.grey), np.zeros_like(image.colour)
                image = replace(image, grey=dark[0], colour=dark[1])
            colour = image.colour if image.colour.size else None
            stamp_ns = int(self.stamps_ns[number]) if on_and_on else number * self.step_ns
            begin = time.process_time()
            tracks = tracker.track(image.grey, stamp_ns)
            delta = mapper.process(Frame(number, stamp_ns, tracks, image.grey, colour))
            mapper.publish_keyframes()
            spent += time.process_time() - begin
            history.apply(delta, frame=number, stamp_ns=stamp_ns)
            joined += [number] * len(delta.joined)
        history.apply(mapper.finish(), frame=len(order) - 1, stamp_ns=0, final=True)
        final = history.final()
        shown = enumerate(order)
        return Played(
            final=_longest(final),
            online=_longest(history.online),
            truth={n: self._truth[source] for n, source in shown if source in self._truth},
            lit=sum(source != DARK for source in order),
            segments=len({segment for segment, _ in final.values()}),
            joined=joined,
            same_places=len(history.same_places),
            compared=vars(mapper.atlas.places.comparisons),
            cpu_ms=1e3 * spent / len(order),
        )


def _longest(poses: dict[int, tuple[int, F64]]) -> dict[int, F64]:
    """Poses of the segment that has most of them."""
    ((longest, _),) = Counter(segment for segment, _ in poses.values()).most_common(1)
    return {number: pose for number, (segment, pose) in poses.items() if segment == longest}
