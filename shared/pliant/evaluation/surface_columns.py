"""A mesh against the true surface as the field's tables have it, registered in several ways.

Monocular systems are compared on 7-Scenes by accuracy (mesh to ground truth), completion (ground
truth to mesh) and Chamfer distance (their mean).  Each is the RMSE over distances below 0.5 m;
VGGT-SLAM's script aligns by the trajectory's Sim(3) and then by ICP.  The other columns show what
ICP hides, and the last one the limit of any map: the true depth itself, seen from our poses.
"""

from dataclasses import dataclass

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.geometry import align_umeyama, so3_log
from pliant.evaluation.criteria import Similarity
from pliant.evaluation.presentation import metres, table
from pliant.evaluation.surface_distance import nearest

CUT_M, NEAR_M = 0.5, 0.05
"""Pairs farther apart are left out of the RMSE; those nearer count for the F-score at 5 cm."""
_GATES = (0.05, 0.01)
"""Shares of the diameter within which ICP takes points for the same, one after the other."""
_ITERATIONS = 40
_SAMPLES = 10_000
"""Samples of the mesh that ICP moves."""
_SETTLED = 1e-5
"""Share of the diameter by which an iteration moves the samples when it is the last."""
_LABELS = {
    "trajectory": "trajectory",
    "icp": "+ ICP",
    "icp_scale": "+ ICP, scale",
    "floor": "floor",
}


@dataclass(frozen=True, kw_only=True)
class SurfaceFigures:
    """Distances in metres, NaN where nothing is near.

    f_score: at 1 % of the diameter.    f_5cm: at 5 cm.    scale, turn_deg, shift_m: by which the
    registration moved what the trajectory aligned; shift_m: of its middle.
    """

    accuracy_m: float
    completion_m: float
    chamfer_m: float
    f_score: float
    f_5cm: float
    scale: float
    turn_deg: float
    shift_m: float


def surface_columns(
    samples: F64, floor: F64, true: F64, diameter_m: float
) -> dict[str, SurfaceFigures]:
    """Figures by column.  Samples (N, 3) of a mesh and (K, 3) of the true depth at its poses, both
    aligned by the trajectory; (M, 3) of the true surface.  None if one of them is empty."""
    if not (len(samples) and len(floor) and len(true)):
        return {}
    still = Similarity(scale=1.0, R=np.eye(3), t=np.zeros(3))
    moves = {
        "trajectory": still,
        "icp": registered(samples, true, diameter_m, with_scale=False),
        "icp_scale": registered(samples, true, diameter_m, with_scale=True),
    }
    columns = {
        name: _figures(move.apply(samples), true, diameter_m, move, samples.mean(axis=0))
        for name, move in moves.items()
    }
    return columns | {"floor": _figures(floor, true, diameter_m, still, floor.mean(axis=0))}


def registered(samples: F64, true: F64, diameter_m: float, *, with_scale: bool) -> Similarity:
    """Point-to-point ICP of samples (N, 3) to the true surface (M, 3)."""
    some = samples[:: -(-len(samples) // _SAMPLES)]
    found = Similarity(scale=1.0, R=np.eye(3), t=np.zeros(3))
    for gate in _GATES:
        for _ in range(_ITERATIONS):
            before = found.apply(some)
            rows, _ = nearest(before, true, gate * diameter_m)
            near = rows >= 0
            if np.count_nonzero(near) < 3:
                break
            try:
                move = align_umeyama(some[near], true[rows[near]], with_scale=with_scale)
            except ValueError:  # all in one place
                break
            found = Similarity(scale=move[0], R=move[1], t=move[2])
            moved = np.linalg.norm(found.apply(some) - before, axis=1)
            if float(moved.max()) < _SETTLED * diameter_m:
                break
    return found


def format_columns(columns: dict[str, SurfaceFigures]) -> str:
    """A table, ready to print."""
    figures = [columns[name] for name in _LABELS if name in columns]
    rows = [["surface", *(_LABELS[name] for name in _LABELS if name in columns)]]
    rows += [
        [f"accuracy, RMSE up to {CUT_M:g} m", *(metres(f.accuracy_m) for f in figures)],
        ["completion, likewise", *(metres(f.completion_m) for f in figures)],
        ["Chamfer, their mean", *(metres(f.chamfer_m) for f in figures)],
        ["F-score at 1 % of the diameter", *(f"{f.f_score:.3f}" for f in figures)],
        [f"F-score at {100 * NEAR_M:g} cm", *(f"{f.f_5cm:.3f}" for f in figures)],
        ["scaled by", *(f"{f.scale:.4f}" for f in figures)],
        ["turned by", *(f"{f.turn_deg:.2f} deg" for f in figures)],
        ["moved by", *(metres(f.shift_m) for f in figures)],
    ]
    return table(rows)


def _figures(
    samples: F64, true: F64, diameter_m: float, move: Similarity, middle: F64
) -> SurfaceFigures:
    limit = 0.01 * diameter_m
    most = max(CUT_M, limit)
    _, there = nearest(samples, true, most)
    _, back = nearest(true, samples, most)
    accuracy, completion = _rmse(there), _rmse(back)
    return SurfaceFigures(
        accuracy_m=accuracy,
        completion_m=completion,
        chamfer_m=0.5 * (accuracy + completion),
        f_score=_f_score(there, back, limit),
        f_5cm=_f_score(there, back, NEAR_M),
        scale=move.scale,
        turn_deg=float(np.degrees(np.linalg.norm(so3_log(move.R[None])))),
        shift_m=float(np.linalg.norm(move.apply(middle[None])[0] - middle)),
    )


def _rmse(distances: F64) -> float:
    near = distances[distances <= CUT_M]
    return float(np.sqrt(np.mean(near**2))) if len(near) else float("nan")


def _f_score(there: F64, back: F64, limit: float) -> float:
    precision, recall = float(np.mean(there <= limit)), float(np.mean(back <= limit))
    return 2.0 * precision * recall / max(precision + recall, 1e-12)
