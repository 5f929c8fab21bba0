"""A mesh against a scan (PLY: points, or a mesh) in the world of the true poses."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.geometry import so3_log
from pliant.errors import ResultError
from pliant.evaluation.criteria import Similarity
from pliant.evaluation.presentation import metres
from pliant.evaluation.surface_columns import registered
from pliant.evaluation.surface_distance import nearest, sample_surface, share_within, thin_out
from pliant.formats.ply import read_ply

SURFACE_LIMIT = 0.01
"""Share of the scan's diameter within which two surfaces are the same, for the F-score."""
_SPACING = 0.25
"""Distance of the samples of both surfaces, as a share of the limit."""


@dataclass(frozen=True, kw_only=True)
class ScanTruth:
    """Figures of a mesh against a scan, after the registration.

    registered: share of the mesh's samples that have one of the scan's within 1 % of its diameter,
    before they were registered.    scale, turn_deg, shift_m: what the registration changed of the
    alignment by poses; shift_m: of the scan's centre.
    accuracy_m, completeness_m: mean distance from mesh to scan, and back.    chamfer_m: the mean of
    both.    precision, recall, f_score: at 1 % of the diameter.
    """

    diameter_m: float
    registered: float
    scale: float
    turn_deg: float
    shift_m: float
    accuracy_m: float
    completeness_m: float
    chamfer_m: float
    precision: float
    recall: float
    f_score: float


def mesh_against_scan(
    result: Path, scan: Path, alignment: Similarity | None, figures: dict[str, Any]
) -> Iterator[str]:
    """The fine mesh of a result folder.  Raises PliantError."""
    if alignment is None:
        raise ResultError("without an aligned trajectory the mesh cannot be placed in the scan")
    if not (result / "mesh.ply").is_file():
        raise ResultError(f"{result}: no mesh.ply: run with a mesh, or `pliant mesh {result}`")
    mesh, true = read_ply(result / "mesh.ply"), read_ply(scan)
    if mesh.faces is None or not len(mesh.faces):
        raise ResultError(f"{result / 'mesh.ply'}: has no triangles")
    if len(true.points) < 3:
        raise ResultError(f"{scan}: has fewer than three points")
    diameter = float(np.linalg.norm(np.ptp(true.points.astype(np.float64), axis=0)))
    spacing = _SPACING * SURFACE_LIMIT * diameter
    if not spacing > 0.0:
        raise ResultError(f"{scan}: all points are equal")
    places = alignment.apply(mesh.points.astype(np.float64))
    samples = thin_out(sample_surface(places, mesh.faces, spacing), spacing)
    surface = true.points.astype(np.float64)
    if true.faces is not None and len(true.faces):
        surface = sample_surface(surface, true.faces, spacing)
    found = compare_with_scan(samples, thin_out(surface, spacing), diameter)
    figures["scan"] = asdict(found)
    yield f"mesh.ply compared with {scan}:"
    yield format_scan(found)


def compare_with_scan(samples: F64, scan: F64, diameter: float) -> ScanTruth:
    """Samples (N, 3) of a mesh, registered to those of a scan (M, 3) by ICP with scale."""
    limit = SURFACE_LIMIT * diameter
    change = registered(samples, scan, diameter, with_scale=True)
    moved = change.apply(samples)
    accuracy, completeness = nearest(moved, scan, np.inf)[1], nearest(scan, moved, np.inf)[1]
    precision, recall = float(np.mean(accuracy <= limit)), float(np.mean(completeness <= limit))
    centre = scan.mean(axis=0)
    return ScanTruth(
        diameter_m=diameter,
        registered=share_within(samples, scan, limit),
        scale=change.scale,
        turn_deg=float(np.degrees(np.linalg.norm(so3_log(change.R[None])))),
        shift_m=float(np.linalg.norm(change.apply(centre[None])[0] - centre)),
        accuracy_m=float(accuracy.mean()),
        completeness_m=float(completeness.mean()),
        chamfer_m=0.5 * float(accuracy.mean() + completeness.mean()),
        precision=precision,
        recall=recall,
        f_score=2.0 * precision * recall / max(precision + recall, 1e-12),
    )


def format_scan(truth: ScanTruth) -> str:
    """Three lines, ready to print."""
    t = truth
    return (
        f"registered by ICP: scale {t.scale:.4f}, rotated by {t.turn_deg:.2f} deg, moved by "
        f"{metres(t.shift_m)}; {100 * t.registered:.1f} % was within 1 % before\ndistance: mesh "
        f"to scan {metres(t.accuracy_m)}, scan to mesh {metres(t.completeness_m)}, chamfer "
        f"{metres(t.chamfer_m)}\nwithin 1 % of the diameter ({t.diameter_m:.2f} m): F-score "
        f"{t.f_score:.3f}, precision {t.precision:.3f}, recall {t.recall:.3f}"
    )
