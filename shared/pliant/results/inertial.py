"""The scale and the vertical of a result from the inertial samples of its source."""

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.inertial.alignment import Refusal, align_inertial
from pliant.algorithms.inertial.samples import ImuSamples
from pliant.map_history import MapHistory
from pliant.results.known_scale import Scale, level_of


def by_samples(history: MapHistory, samples: ImuSamples) -> Scale | str:
    """Scale and vertical of the longest segment, or in one line why they cannot be estimated."""
    longest = history.longest_segment()
    if longest < 0:
        return "there is no map"
    poses = history.trajectory_in(longest, history.final())
    found = align_inertial(poses.stamps_ns, poses.T_world_camera, samples)
    if isinstance(found, Refusal):
        return found.reason
    return Scale(
        metres_per_unit=found.metres_per_unit,
        sigma=found.scale_sigma,
        source=(
            f"inertial samples of {found.seconds:.0f} s, {1e3 * found.time_offset_s:+.1f} ms from "
            "the images"
        ),
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
