"""A sequence forth and back, as two sessions with the dark between them, and with kidnappings."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.played import Played, Reel
from benchmarks.table import markdown_header, markdown_row
from pliant.config import Config
from pliant.evaluation.presentation import metres

_DARK_S = 1.5
_AGAIN = 0.1
"""Of the first session's frames, the last ones: the second session comes back as far as these."""
_HEADER = (
    *("source", "places", "forth and back", "two sessions", "of the same frames", "segments"),
    *("joined at", "poses"),
)

_KIDNAPPINGS = 10
_SEEN_S = 0.7
"""After each."""
_GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)
_KIDNAPPED = (
    *("source", "kidnapped", "times", "found", "frames until found: median", "worst", "segments"),
    *("poses", "ATE", "worst", "online", "worst"),
)


def measure(sources: list[str], config: Config) -> Iterator[str]:
    """Two rows for each source, with places and without.

    The same frames: those that have a pose in the longest segment of both.
    """
    yield markdown_header(_HEADER)
    for name in sources:
        reel = Reel(name, config)
        count = len(reel)
        middle = count // 2
        last = middle - round(_AGAIN * middle)
        back = list(range(count - 1, last - 1, -1))
        orders = [*range(count), *back], [*range(middle), *reel.night(_DARK_S), *back]
        played = {on: [reel.play(order, places=on) for order in orders] for on in (True, False)}
        same = played[True][1].final.keys() & played[False][1].final.keys()
        for on, (whole, cut) in played.items():
            cells = (
                *(Path(name).name, "on" if on else "off", metres(whole.ate_m(whole.final))),
                *(metres(cut.ate_m(cut.final)), metres(cut.ate_m(cut.final, same))),
                *(str(cut.segments), ", ".join(map(str, cut.joined)) or "-", cut.share),
            )
            yield markdown_row(cells)


def kidnappings(sources: list[str], config: Config) -> Iterator[str]:
    """Two rows for each source: from the dark, and by a cut from image to image."""
    yield markdown_header(_KIDNAPPED)
    for name in sources:
        reel = Reel(name, config)
        for how, seconds in (("in the dark", _DARK_S), ("at once", 0.0)):
            order, arrivals = kidnapped(reel, seconds, _KIDNAPPINGS)
            came = reel.play(order)
            until = frames_until_found(came, arrivals)
            waited = [len(a) if n is None else n for n, a in zip(until, arrivals, strict=True)]
            errors = [came.errors_m(poses) for poses in (came.final, came.online)]
            cells = (
                *(Path(name).name, how, str(len(arrivals)), str(len(until) - until.count(None))),
                *(f"{np.median(waited):g}", str(max(waited)), str(came.segments), came.share),
                *(each for e in errors for each in (metres(_rms(e)), metres(float(e.max())))),
            )
            yield markdown_row(cells)


def kidnapped(reel: Reel, dark_s: float, times: int) -> tuple[list[int], list[range]]:
    """The whole sequence, and then a short stretch of it, and another, forwards and backwards.

    dark_s: before each.   Returns the order of frames, and the numbers of the images of each
    stretch.
    """
    length = round(1e9 * _SEEN_S / reel.step_ns)
    order, arrivals = list(range(len(reel))), list[range]()
    for k in range(times):
        begin = int((k * _GOLDEN % 1.0) * (len(reel) - length))
        stretch = range(begin, begin + length)
        order += reel.night(dark_s)
        arrivals.append(range(len(order), len(order) + length))
        order += stretch if k % 2 == 0 else reversed(stretch)
    return order, arrivals


def frames_until_found(came: Played, arrivals: list[range]) -> list[int | None]:
    """After each kidnapping, 1: at once.   None: never in its stretch."""
    first = [next((n for n in seen if n in came.online), None) for seen in arrivals]
    return [None if n is None else n - seen[0] + 1 for n, seen in zip(first, arrivals, strict=True)]


def _rms(errors: np.ndarray) -> float:
    return float(np.sqrt((errors**2).mean()))
