"""Where the map of a recording lies on the Earth, by the satellite fixes of its source."""

from pliant.algorithms.inertial.alignment import InertialAlignment, align_inertial
from pliant.algorithms.inertial.gps_fit import GpsFit, GpsRefusal, fit_to_fixes
from pliant.errors import ResultError
from pliant.recording.measured import fixes_of, imu_of
from pliant.recording.reader import Recording
from pliant.trajectory import Trajectory


def place_on_earth(
    recording: Recording, trajectory: Trajectory, *, oriented: bool = True
) -> GpsFit:
    """The similarity from the world of a trajectory to the Earth.   oriented: else its scale alone.

    Gravity is that of the inertial samples, where they give it.
    Raises ResultError where the fixes do not determine it, or there are none.
    """
    fixes = fixes_of(recording)
    if not len(fixes.stamps_ns):
        raise ResultError(
            f"{recording.path}: the source had no satellite fixes: pass --gps FILE to pliant run"
        )
    samples = imu_of(recording)
    up = None
    if len(samples.stamps_ns):
        found = align_inertial(trajectory.stamps_ns, trajectory.T_world_camera, samples)
        up = found.up if isinstance(found, InertialAlignment) else None
    fit = fit_to_fixes(trajectory.stamps_ns, trajectory.positions, fixes, up, oriented=oriented)
    if isinstance(fit, GpsRefusal):
        raise ResultError(f"{recording.path}: satellite fixes: {fit.reason}")
    return fit


def summary_of(fit: GpsFit) -> str:
    """A fit in words."""
    return (
        f"{fit.agreeing} of {fit.fixes} satellite fixes, error {fit.error_m:.1f} m, "
        f"clock {fit.offset_s:+.2f} s"
    )
