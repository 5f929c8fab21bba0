"""Sources whose camera comes back to where it began: how far off it is then, with places and not.

The end error is that of the last poses where the first ones are aligned: what the whole way round
has left.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.played import Played, Reel
from benchmarks.table import markdown_header, markdown_row
from pliant.config import Config
from pliant.evaluation.presentation import metres

_FIRST, _LAST = 100, 10
"""Poses that are aligned, and that are measured."""
_HEADER = (
    *("source", "path", "places", "ATE final", "online", "end error", "of the path"),
    *("compared", "pairs of places", "segments", "poses", "CPU a frame"),
)


def measure(sources: list[str], config: Config) -> Iterator[str]:
    """Two rows for each source.   Compared: pairs of keyframes, and what came of them.   Pairs of
    places: keyframes by which loops were closed."""
    yield markdown_header(_HEADER)
    for name in sources:
        reel = Reel(name, config)
        for places in (True, False):
            came = reel.play(range(len(reel)), places=places)
            path, end = path_m(came), end_error_m(came)
            cells = (
                *(Path(name).name, f"{path:.0f} m", "on" if places else "off"),
                *(metres(came.ate_m(came.final)), metres(came.ate_m(came.online))),
                *(metres(end), f"{100.0 * end / path:.4f} %", _told(came.compared)),
                *(str(came.same_places), str(came.segments), came.share, f"{came.cpu_ms:.0f} ms"),
            )
            yield markdown_row(cells)


def _told(compared: dict[str, int]) -> str:
    """What there was of it."""
    told = (f"{count} {name.replace('_', ' ')}" for name, count in compared.items() if count)
    return ", ".join(told) or "-"


def path_m(came: Played) -> float:
    """Length of the true path."""
    true = np.array([came.truth[n] for n in sorted(came.truth)])
    return float(np.linalg.norm(np.diff(true, axis=0), axis=1).sum())


def end_error_m(came: Played) -> float:
    """Mean error of the last final poses after the Sim(3) that aligns the first ones."""
    return float(came.errors_m(came.final, by=_FIRST)[-_LAST:].mean())
