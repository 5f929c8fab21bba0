"""Times of stages, collected frame by frame."""

import time
from collections import defaultdict
from collections.abc import Callable, Generator
from contextlib import contextmanager

import numpy as np


class Stopwatch:
    """A StageTimer that adds up each stage's time per frame; ``lap`` closes a frame."""

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock = clock
        self._frame: dict[str, float] = defaultdict(float)
        self.laps: list[dict[str, float]] = []

    @contextmanager
    def __call__(self, stage: str) -> Generator[None]:
        """Time a stage of the current frame."""
        start = self._clock()
        try:
            yield
        finally:
            self._frame[stage] += self._clock() - start

    def lap(self) -> None:
        """Close the frame."""
        self.laps.append(dict(self._frame))
        self._frame.clear()

    def median_ms(self, stage: str) -> float:
        """Median over the frames, 0 where a frame did without the stage."""
        return 1e3 * float(np.median([lap.get(stage, 0.0) for lap in self.laps]))

    def mean_ms(self, stage: str | None = None) -> float:
        """Mean over the frames, of one stage or of all."""
        totals = [sum(lap.values()) if stage is None else lap.get(stage, 0.0) for lap in self.laps]
        return 1e3 * float(np.mean(totals)) if totals else 0.0

    @property
    def stages(self) -> list[str]:
        """Every stage in order of its first appearance."""
        return list(dict.fromkeys(stage for lap in self.laps for stage in lap))
