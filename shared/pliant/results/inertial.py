"""The scale and the vertical of a result from the inertial samples of its source, and what these
did to its keyframes."""

from typing import Any

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.inertial.alignment import Refusal, align_inertial
from pliant.algorithms.inertial.samples import ImuSamples
from pliant.algorithms.slam.adjust.inertial_adjustment import CouplingOutcome
from pliant.map_history import MapHistory
from pliant.recording.summary import SECOND_PASS
from pliant.results.known_scale import Scale, level_of
from pliant.results.run import Run

_REFUSALS = {
    CouplingOutcome.NOT_ALIGNED: "they do not fit the keyframes",
    CouplingOutcome.UNKNOWN_TIMES: "the map continues a saved one, or has a single keyframe",
    CouplingOutcome.TOO_MANY: "there are more than 600 keyframes",
    CouplingOutcome.FOCAL_CHANGES: "the focal length changes",
    CouplingOutcome.DIVERGED: "the estimate does not converge",
    CouplingOutcome.TOO_NOISY: "the residuals are more than ten times the noise",
    CouplingOutcome.IMAGES_DISAGREE: "the reprojection errors would grow more than predicted",
    CouplingOutcome.CALIBRATION_FIXED: "the calibration is fixed",
}
_OTHER_CLOCK_S = 10.0
"""Clocks that differ by more are not one clock with a delay: milliseconds would be unreadable."""


def coupling_of(run: Run) -> dict[str, Any] | None:
    """What inertial samples did to the keyframes of the largest segment; None if there are none.

    keyframes: of the segment.   moved_mm: median of their motion.   refusal: why they stayed.
    """
    second = run.recorded.metadata.get(SECOND_PASS, {})
    counters = dict(run.counters.get("bundle_adjustment", {}))
    counters |= {n: float(value) for n, value in second.items() if n.startswith("coupling_")}
    if "coupling_outcome" not in counters:
        return None
    return {
        "keyframes": int(counters["coupling_keyframes"]),
        "moved_mm": round(1e3 * counters["coupling_moved_m"], 4),
        "refusal": _REFUSALS.get(CouplingOutcome(int(counters["coupling_outcome"])), ""),
    }


def by_samples(history: MapHistory, samples: ImuSamples) -> Scale | str:
    """Scale and vertical of the longest segment, or in one line why they cannot be estimated."""
    longest = history.longest_segment()
    if longest < 0:
        return "there is no map"
    poses = history.trajectory_in(longest, history.final())
    found = align_inertial(poses.stamps_ns, poses.T_world_camera, samples)
    if isinstance(found, Refusal):
        return found.reason
    offset_s = found.time_offset_s
    offset = f"{1e3 * offset_s:+.1f} ms" if abs(offset_s) < _OTHER_CLOCK_S else f"{offset_s:+.3f} s"
    negated = " with accelerations of the opposite sign" if found.accel_sign < 0.0 else ""
    return Scale(
        metres_per_unit=found.metres_per_unit,
        sigma=found.scale_sigma,
        source=(f"inertial samples of {found.seconds:.0f} s{negated}, {offset} from the images"),
        level=level_of(upright(found.up), float(np.degrees(found.up_sigma_rad))),
    )


def upright(up: F64) -> F64:
    """(3, 3) the smallest rotation of a unit vector to z: a camera that begins upright and looks
    ahead then looks along y."""
    z = np.array([0.0, 0.0, 1.0])
    middle = up + z
    if np.linalg.norm(middle) < 1e-6:
        return np.diag([1.0, -1.0, -1.0])
    middle = middle / np.linalg.norm(middle)
    # Two reflections: by the plane across the vector between both, and by that across z.
    half = np.eye(3) - 2.0 * np.outer(middle, middle)
    return (np.eye(3) - 2.0 * np.outer(z, z)) @ half
