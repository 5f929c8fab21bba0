"""Where the map of a recording lies on the Earth, by the satellite fixes of its source."""

import numpy as np

from pliant.algorithms.inertial.gps_fit import GpsFit, GpsRefusal, fit_to_fixes
from pliant.errors import ResultError
from pliant.recording.measured import fixes_of
from pliant.recording.reader import Recording
from pliant.results.known_scale import Level, Scale
from pliant.results.run import Run
from pliant.trajectory import Trajectory


def place_on_earth(
    recording: Recording, run: Run, trajectory: Trajectory, *, oriented: bool = True
) -> GpsFit:
    """Return the similarity from the world of a trajectory to the Earth.   oriented: otherwise only
    its scale.

    run: of the trajectory; where it is level, its z is up.
    Raises ResultError if the fixes do not determine it, or there are none.
    """
    fixes = fixes_of(recording)
    if not len(fixes.stamps_ns):
        raise ResultError(
            f"{recording.path}: the source had no satellite fixes: pass --gps FILE to pliant run"
        )
    up = np.array([0.0, 0.0, 1.0]) if run.z_is_up else None
    fit = fit_to_fixes(trajectory.stamps_ns, trajectory.positions, fixes, up, oriented=oriented)
    if isinstance(fit, GpsRefusal):
        raise ResultError(f"{recording.path}: satellite fixes: {fit.reason}")
    return fit


def scale_by(fit: GpsFit, level: Level | None = None) -> Scale:
    """The scale that a fit gives.   level: of the same map, where it is known."""
    return Scale(
        metres_per_unit=fit.metres_per_unit,
        sigma=fit.scale_sigma,
        source=summary_of(fit),
        level=level,
    )


def summary_of(fit: GpsFit) -> str:
    """A fit in words."""
    return (
        f"{fit.agreeing} of {fit.fixes} satellite fixes, error {fit.error_m:.1f} m, "
        f"clock {fit.offset_s:+.2f} s"
    )
