"""What each addition to the paper is worth: every switch off in turn, and all of them."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from benchmarks.in_process import run
from benchmarks.table import markdown_header, markdown_row
from pliant.datasets import open_source
from pliant.errors import PliantError

_OFF = {
    "local flow": ["tracking.local_flow=false"],
    "sub-pixel extrema": ["tracking.subpixel=false"],
    "patch refinement and coasting": ["tracking.patch_refinement=false"],
    "turned patches": ["tracking.turn_patches=false"],
    "coasting": ["tracking.coast_s=0"],
    "minima beside maxima": ["tracking.both_signs=false"],
    "re-acquisition": ["bundle_adjustment.reacquisition.enabled=false"],
    "sweeps on every frame": ["bundle_adjustment.window.sweeps=0"],
    "final adjustment": ["bundle_adjustment.window.final_adjustment=false"],
    "readout of a rolling shutter": ["bundle_adjustment.calibration.readout=0"],
}
_TRACKER = ("local flow", "sub-pixel extrema", "patch refinement and coasting")
_LITERAL = [s for name in _TRACKER for s in _OFF[name]]
_LITERAL += _OFF["minima beside maxima"]

VARIANTS: dict[str, list[str]] = {
    "everything on": [],
    **{f"without {name}": sets for name, sets in _OFF.items()},
    "the paper's tracker": _LITERAL,
    "the paper's tracker, without re-acquisition": [*_LITERAL, *_OFF["re-acquisition"]],
}


def measure(sources: Sequence[str], *, only: Sequence[str], seeds: int) -> Iterator[str]:
    """Final / online ATE (share of the frames below 99 %), a column for each source.

    only: of the switches, everything on beside them; none: all.   seeds: runs of each, numbered
    from 0.   Raises PliantError for a switch that there is not.
    """
    if unknown := sorted(set(only) - set(_OFF)):
        raise PliantError(f"no switch '{unknown[0]}': there are {', '.join(_OFF)}")
    chosen = ["everything on", *(f"without {name}" for name in only)] if only else list(VARIANTS)
    yield markdown_header(["variant", *(Path(source).name for source in sources)])
    for name in chosen:
        cells = (
            ", ".join(_cell(source, [*VARIANTS[name], f"seed={seed}"]) for seed in range(seeds))
            for source in sources
        )
        yield markdown_row([name, *cells])


def _cell(source: str, overrides: Sequence[str]) -> str:
    return run(open_source(source), overrides).both
