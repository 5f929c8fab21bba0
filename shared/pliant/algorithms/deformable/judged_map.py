"""A map that deforms, from the tracks of keyframes, and whether it may be trusted."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from pliant.algorithms.arrays import F64, I64, Shape
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.deformable.adjustment import adjust_deforming
from pliant.algorithms.deformable.held_out import Evidence, weigh
from pliant.algorithms.deformable.moving_landmarks import DeformingMap, TrackedPoints
from pliant.algorithms.deformable.track_choice import choose_tracks

INTERVAL_NS = 190_000_000
"""Least time between two keyframes: 0.2 s, less the jitter of a clock."""
TOO_FEW = "too few tracks through several keyframes determine it"
_NO_JUDGES = "too few other tracks judge it"
_AS_RIGID = "a rigid map predicts its tracks as well, or nearly so"
_FEWEST = 30
"""Tracks that judge it."""
_CERTAIN, _PREDICTED, _GAIN, _STIFF = 0.65, 0.95, 0.6, 0.3
"""Least share of certain landmarks, and least figures of the evidence.

Scenes whose map is right have 0.79, 0.98, 0.7 and 0.35 or more.  Rigid scenes with an inexact
calibration have up to 0.83, 0.95, 0.5 and 1.0; with a camera that hardly moves 0.3, 1.0, 3 and 1.0.
"""


@dataclass(frozen=True, kw_only=True)
class JudgedMap:
    """found: of these ``tracks``.    ids: (L,) the track of each landmark.
    problem: why it is not to be trusted, "" where it is."""

    found: DeformingMap
    tracks: TrackedPoints
    ids: Annotated[I64, Shape("L")]
    problem: str


def judged_map(
    ids: Sequence[I64],
    points_px: Sequence[F64],
    T_world_camera: F64,
    camera: PinholeCamera,
    *,
    must_deform: bool = False,
) -> JudgedMap | str:
    """Adjust K keyframes; where their tracks determine nothing, the reason.

    ids, points_px: (N,) and (N, 2) tracks of each.    T_world_camera: (K, 4, 4) start.
    must_deform: refuse it where a rigid map does as well.
    """
    size = camera.width, camera.height
    chosen, landmarks = choose_tracks(list(ids), list(points_px), *size)
    others = [~np.isin(of, landmarks) for of in ids]
    held_out, judges = choose_tracks(
        [of[other] for of, other in zip(ids, others, strict=True)],
        [at[other] for at, other in zip(points_px, others, strict=True)],
        *size,
    )
    if len(judges) < _FEWEST:
        return _NO_JUDGES if len(landmarks) >= _FEWEST else TOO_FEW
    try:
        found = adjust_deforming(chosen, T_world_camera, camera)
        evidence = weigh(found, held_out, camera)
    except (ValueError, ArithmeticError, np.linalg.LinAlgError):
        return TOO_FEW
    problem = doubt(float(found.reliable.mean()), evidence, must_deform=must_deform)
    return JudgedMap(found=found, tracks=chosen, ids=landmarks, problem=problem)


def doubt(certain: float, evidence: Evidence, *, must_deform: bool = False) -> str:
    """Why a map is not to be trusted, "" where it is."""
    if not certain >= _CERTAIN:
        return f"only {certain:.0%} of its landmarks are certain"
    if not evidence.predicted >= _PREDICTED:
        return f"it predicts only {evidence.predicted:.0%} of the tracks that it was not made from"
    if must_deform and not evidence.gain >= _GAIN:
        return _AS_RIGID
    if not evidence.stiff >= _STIFF:
        return (
            f"only {evidence.stiff:.0%} of its landmarks hardly move, "
            "so camera and deformation cannot be told apart"
        )
    return ""


def is_evidence(problem: str) -> bool:
    """Whether a problem speaks against cameras and depths of the whole run: too few tracks do
    not."""
    return problem not in ("", TOO_FEW, _NO_JUDGES)
