"""A sequence forth and back, whole and as two sessions with the dark between them: one map?"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.table import markdown_header, markdown_row
from pliant.algorithms.geometry import align_umeyama
from pliant.algorithms.mapping.trial import mapper_for
from pliant.algorithms.tracking.tracker import ExtremaTracker
from pliant.config import Config
from pliant.datasets import open_source
from pliant.datasets.rectifier import Rectifier, rectified
from pliant.evaluation.report import metres
from pliant.formats.trajectory_files import read_trajectory
from pliant.map_history import MapHistory
from pliant.trajectory import associate

_DARK_S = 1.5
_AGAIN = 0.1
"""Of the first session's frames, the last ones: the second session comes back as far as these."""
_DARK = -1
_HEADER = ("source", "forth and back", "two sessions", "segments", "joined at", "poses")


@dataclass
class _Seen:
    """ate_m: of the longest segment.    share: of its poses among the frames that are lit."""

    ate_m: float
    segments: int
    joined: list[int]
    share: float


class _Sequence:
    def __init__(self, name: str, config: Config) -> None:
        self._config = config
        dataset = open_source(name)
        self._calibration = dataset.calibration
        self._frames = list(dataset)
        self._stamps_ns = np.array([frame.stamp_ns for frame in self._frames])
        assert dataset.ground_truth_path is not None
        truth = read_trajectory(Path(dataset.ground_truth_path))
        mine, true = associate(self._stamps_ns, truth.stamps_ns)
        self._truth = dict(zip(mine.tolist(), truth.positions[true], strict=True))
        self.step_ns = int(np.median(np.diff(self._stamps_ns)))

    def __len__(self) -> int:
        return len(self._frames)

    def run(self, order: list[int]) -> _Seen:
        """Frames one after the other, at the sequence's rate."""
        rectifier, config = Rectifier(self._calibration), self._config
        camera = rectifier.camera
        tracker = ExtremaTracker(camera.width, camera.height, config.tracking, config.seed)
        mapper = mapper_for(
            camera, config.bundle_adjustment, config.seed, self._calibration.focal_sigma
        )
        history, joined = MapHistory(), list[int]()
        for number, source in enumerate(order):
            image = rectified(self._frames[max(source, 0)], rectifier)
            if source == _DARK:
                dark = np.zeros_like(image.grey), np.zeros_like(image.colour)
                image = replace(image, grey=dark[0], colour=dark[1])
            colour = image.colour if image.colour.size else None
            stamp_ns, tracks = number * self.step_ns, tracker.track(image.grey)
            delta = mapper.process(number, stamp_ns, tracks, image.grey, colour)
            mapper.publish_keyframes()
            history.apply(delta, frame=number, stamp_ns=stamp_ns)
            joined += [number] * len(delta.joined)
        history.apply(mapper.finish(), frame=len(order) - 1, stamp_ns=0, final=True)
        longest, final = history.longest_segment(), history.final()
        poses = {n: pose for n, (segment, pose) in final.items() if segment == longest}
        known = [n for n in poses if order[n] in self._truth]
        mine = np.array([poses[n][:3] for n in known])
        true = np.array([self._truth[order[n]] for n in known])
        scale, R, t = align_umeyama(mine, true, with_scale=True)
        errors = np.linalg.norm(scale * mine @ R.T + t - true, axis=1)
        return _Seen(
            ate_m=float(np.sqrt((errors**2).mean())),
            segments=len({segment for segment, _ in final.values()}),
            joined=joined,
            share=len(poses) / sum(source != _DARK for source in order),
        )


def measure(sources: list[str], config: Config) -> Iterator[str]:
    """A row for each source, whose frames have true poses."""
    yield markdown_header(_HEADER)
    for name in sources:
        sequence = _Sequence(name, config)
        count = len(sequence)
        middle = count // 2
        last = middle - round(_AGAIN * middle)
        back = list(range(count - 1, last - 1, -1))
        whole = sequence.run([*range(count), *back])
        dark = [_DARK] * round(1e9 * _DARK_S / sequence.step_ns)
        cut = sequence.run([*range(middle), *dark, *back])
        yield markdown_row(
            (
                *(Path(name).name, metres(whole.ate_m), metres(cut.ate_m), str(cut.segments)),
                *(", ".join(map(str, cut.joined)) or "-", f"{100.0 * cut.share:.1f} %"),
            )
        )
