"""What each addition to the paper is worth: every switch off in turn, and all of them."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from benchmarks.in_process import run
from benchmarks.table import markdown
from pliant.datasets import open_source

_OFF = {
    "mutual check": ["tracking.mutual_check=false"],
    "local flow": ["tracking.local_flow=false"],
    "de-duplication": ["tracking.deduplicate=false"],
    "sub-pixel extrema": ["tracking.subpixel=false"],
    "patch refinement and coasting": ["tracking.patch_refinement=false"],
    "turned patches": ["tracking.turn_patches=false"],
    "coasting": ["tracking.coast_frames=0"],
    "minima beside maxima": ["tracking.both_signs=false"],
    "re-acquisition": ["bundle_adjustment.reacquisition.enabled=false"],
    "sweeps on every frame": ["bundle_adjustment.window.sweeps=0"],
    "final adjustment": ["bundle_adjustment.window.final_adjustment=false"],
    "readout of a rolling shutter": ["bundle_adjustment.calibration.readout=0"],
}
_TRACKER = ("mutual check", "local flow", "de-duplication", "sub-pixel extrema")
_LITERAL = [s for name in (*_TRACKER, "patch refinement and coasting") for s in _OFF[name]]
_LITERAL += _OFF["minima beside maxima"]

VARIANTS: dict[str, list[str]] = {
    "everything on": [],
    **{f"without {name}": sets for name, sets in _OFF.items()},
    "the paper's tracker": _LITERAL,
    "the paper's tracker, without re-acquisition": [*_LITERAL, *_OFF["re-acquisition"]],
}


def measure(sources: Sequence[str]) -> Iterator[str]:
    """ATE (success rate where below 99 %) / median mapped inliers, a column for each source."""
    header = ["variant", *(Path(source).name for source in sources)]
    rows = []
    for name, overrides in VARIANTS.items():
        rows.append([name, *(_cell(source, overrides) for source in sources)])
    yield "ATE of the final trajectory / median mapped inliers"
    yield markdown(header, rows)


def _cell(source: str, overrides: Sequence[str]) -> str:
    found = run(open_source(source), overrides)
    return f"{found.ate} / {found.inliers:.0f}"
