"""The scale and the vertical of a result from the other sensors of its source."""

from pliant.algorithms.inertial.gps_fit import GpsRefusal, fit_to_fixes
from pliant.recording.measured import fixes_of, imu_of
from pliant.recording.reader import Recording
from pliant.results.earth import scale_by
from pliant.results.inertial import by_samples
from pliant.results.known_scale import Scale
from pliant.results.run import Run


def by_sensors(recording: Recording, run: Run) -> Scale | None:
    """The most certain scale of the longest segment, and the vertical by inertial samples;
    None without.   run: without a scale; it notes why samples and fixes were not used.

    Raises MessageError.
    """
    samples, fixes, found = imu_of(recording), fixes_of(recording), None
    if len(samples.stamps_ns):
        result = by_samples(run.history, samples)
        if isinstance(result, Scale):
            found = result
        else:
            run.inertial_refusal = result
    longest = run.history.longest_segment()
    if not len(fixes.stamps_ns) or longest < 0:
        return found
    poses = run.history.trajectory_in(longest, run.history.final())
    level = None if found is None else found.level
    up = None if level is None else level.R[2]
    fit = fit_to_fixes(poses.stamps_ns, poses.positions, fixes, up, oriented=False)
    if isinstance(fit, GpsRefusal):
        run.gps_refusal = fit.reason
        return found
    by_fixes = scale_by(fit, level)
    return by_fixes if found is None or by_fixes.sigma < found.sigma else found
