"""The start of a map whose focal length is a guess: several hypotheses are tried."""

import dataclasses

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.slam.calibration.corrected_view import corrected_view
from pliant.algorithms.slam.calibration.held_unknowns import ASPECT, PRINCIPAL_POINT
from pliant.algorithms.slam.calibration.self_calibration import GROWTH, SelfCalibration, is_guess
from pliant.algorithms.slam.estimate.problem import (
    SHARED,
    BundleProblem,
    BundleResult,
    shared_intrinsics,
)
from pliant.algorithms.slam.estimate.schur import solve_schur
from pliant.algorithms.slam.parameters import MappingParameters
from pliant.algorithms.slam.start.backfill import backfill
from pliant.algorithms.slam.start.first_map import BufferedFrame, Start
from pliant.algorithms.slam.start.start import find_start, waits_long, why_no_start

_HYPOTHESES = np.linspace(-2.0, 2.0, 7)
"""Focal length hypotheses of a start, in standard deviations of the prior."""


def find_start_of(
    waiting: list[BufferedFrame], known: SelfCalibration, parameters: MappingParameters
) -> tuple[Start, SelfCalibration] | str:
    """As ``find_start``, and the camera that the start estimates if its calibration is a guess."""
    if is_guess(parameters.calibration) and not known.next_keyframes:
        return _find_start_of_guess(waiting, known, parameters)
    camera = known.view.camera
    found = find_start(waiting, camera, parameters)
    if isinstance(found, str):
        return found
    return backfill(found, waiting, camera, parameters), known


def _find_start_of_guess(
    waiting: list[BufferedFrame], known: SelfCalibration, parameters: MappingParameters
) -> tuple[Start, SelfCalibration] | str:
    """Return the start under the focal length that is most consistent with it.

    It waits while some rotation and lens explain the flow, or any focal length has too little
    parallax: a wrong one sees parallax in every rotation.  Angles shrink as a focal length grows;
    after a while the same parallax in px is enough for the longer ones.  Only the motion that fits
    two views best is tried, because a wrong focal length bends all motions until they are alike.
    The map begins again with the right one (``calibration_bootstrap.py``), which compares motions
    and waits for more parallax: the farther the camera has moved, the fewer tracks agree with a
    wrong one.
    """
    sigma = parameters.calibration.focal
    tried = [known.correction + k * sigma * np.eye(SHARED)[0] for k in _HYPOTHESES]
    cameras = [corrected_view(known.given, tuple(each.tolist())).camera for each in tried]
    reason = why_no_start(waiting, known.view.camera, parameters)
    if reason:
        return reason
    best: tuple[float, Start, F64] | None = None
    start = parameters.start
    for correction, camera in zip(tried, cameras, strict=True):
        share = min(1.0, known.given.fx / camera.fx) if waits_long(waiting, start) else 1.0
        wanted = {"patient_s": 0.0, "min_parallax_deg": share * start.min_parallax_deg}
        limits = parameters.model_copy(update={"start": start.model_copy(update=wanted)})
        found = find_start(waiting, camera, limits, motions=1)
        if isinstance(found, str):
            return found
        refined = _refine(found, camera, parameters)
        cost = refined.final_cost / len(found.points_px)
        if best is None or cost < best[0]:
            poses, points = refined.T_world_camera, refined.points_world
            begun = dataclasses.replace(found, T_world_camera=poses, points_world=points)
            best = cost, begun, correction + refined.correction
    assert best is not None
    _, begun, correction = best
    following = int(np.ceil(GROWTH * len(begun.frames)))
    estimated = dataclasses.replace(
        known, correction=correction, next_keyframes=following, changes=False, log_focal=0.0
    )
    return begun, estimated


def _refine(start: Start, camera: PinholeCamera, parameters: MappingParameters) -> BundleResult:
    """Return the start with its focal length free."""
    count = len(start.frames)
    problem = BundleProblem(
        T_world_camera=start.T_world_camera,
        points_world=start.points_world,
        camera_index=start.keyframe_index,
        point_index=start.point_index,
        points_px=start.points_px,
        intrinsics=shared_intrinsics(camera, count),
        fixed_cameras=np.arange(count) == 0,
    )
    held = {"k1": 0.0, "k2": 0.0, "readout": 0.0, PRINCIPAL_POINT: 0.0, ASPECT: 0.0}
    uncertainty = parameters.calibration.model_copy(update=held)
    return solve_schur(problem, parameters.bundle, uncertainty=uncertainty)
