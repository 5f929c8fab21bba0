"""What the map is worth that knows its places: sources with them and without, lit and cut."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.played import DARK, Reel
from benchmarks.table import markdown_header, markdown_row
from pliant.config import Config
from pliant.evaluation.presentation import metres

_DARK_S = 2.0
_HEADER = (
    *("source", "places", "ATE final", "of the same frames", "online", "of the same frames"),
    *("poses", "segments", "CPU a frame"),
)


def measure(
    sources: list[str], config: Config, *, lit: bool = True, cut: bool = True
) -> Iterator[str]:
    """Four rows for each source: as it is and cut, with places and without.

    Cut: it is dark for a while in the middle, and the camera moves on meanwhile.   The same frames:
    those that have a pose in the longest segment of both.   lit, cut: whether to show it so.
    """
    yield markdown_header(_HEADER)
    for name in sources:
        reel = Reel(name, config)
        middle = reel.stamps_ns[len(reel) // 2]
        dark = (reel.stamps_ns >= middle) & (reel.stamps_ns < middle + 1e9 * _DARK_S)
        orders = {"": list(range(len(reel)))} if lit else {}
        if cut:
            title = f", {_DARK_S:.0f} s dark"
            orders[title] = np.where(dark, DARK, np.arange(len(reel))).tolist()
        for title, order in orders.items():
            played = {on: reel.play(order, places=on) for on in (True, False)}
            final = played[True].final.keys() & played[False].final.keys()
            online = played[True].online.keys() & played[False].online.keys()
            for on, came in played.items():
                cells = (
                    *(Path(name).name + title, "on" if on else "off"),
                    *(metres(came.ate_m(came.final)), metres(came.ate_m(came.final, final))),
                    *(metres(came.ate_m(came.online)), metres(came.ate_m(came.online, online))),
                    *(came.share, str(came.segments), f"{came.cpu_ms:.0f} ms"),
                )
                yield markdown_row(cells)
