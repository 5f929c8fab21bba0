"""Values over the time of a run, drawn as SVG."""

from collections.abc import Sequence
from dataclasses import dataclass

BLUE, ORANGE = "#3d8bfd", "#f08c2e"
_WIDTH, _HEIGHT = 720, 150
_LEFT, _RIGHT, _TOP, _BOTTOM = 50.0, _WIDTH - 10.0, 10.0, _HEIGHT - 20.0


@dataclass(frozen=True)
class Line:
    """values: one for each place, of the same length.  places: on the chart's axis."""

    places: Sequence[float]
    values: Sequence[float]
    colour: str


def chart(
    lines: Sequence[Line], *, span: tuple[float, float], top: float, labels: tuple[str, str, str],
    shaded: Sequence[float] = (),
) -> str:  # fmt: skip
    """An <svg>: one polyline for each line, thinned to what a screen shows.

    span: first and last place.   top: the value at the upper edge.   shaded: places of width 1.
    labels: what is drawn, the text at the upper edge, and that at the right end of the axis.
    """
    across = (_RIGHT - _LEFT) / max(span[1] - span[0], 1e-9)
    of, highest, end = labels

    def polyline(line: Line) -> str:
        step = max(1, len(line.places) // _WIDTH)
        points = " ".join(
            f"{_LEFT + across * (place - span[0]):.1f},"
            f"{_BOTTOM - (_BOTTOM - _TOP) * value / top:.1f}"
            for place, value in list(zip(line.places, line.values, strict=True))[::step]
        )
        return (
            f'<polyline fill="none" stroke="{line.colour}" stroke-width="1.5" points="{points}"/>'
        )

    bars = "".join(
        f'<rect class="lost" x="{_LEFT + across * (place - span[0]):.1f}" y="{_TOP:.0f}" '
        f'width="{max(across, 0.7):.1f}" height="{_BOTTOM - _TOP:.0f}"/>'
        for place in shaded
    )
    return (
        f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{of}">{bars}'
        f'<line class="axis" x1="{_LEFT:.0f}" x2="{_RIGHT:.0f}" y1="{_BOTTOM:.0f}" '
        f'y2="{_BOTTOM:.0f}"/>{"".join(map(polyline, lines))}'
        f'<text x="4" y="16">{highest}</text><text x="4" y="{_BOTTOM + 4:.0f}">0</text>'
        f'<text x="{_RIGHT:.0f}" y="{_HEIGHT - 4}" text-anchor="end">{end}</text></svg>'
    )
