"""The scale of a map from satellite fixes that came with its source."""

from pliant.errors import ResultError
from pliant.recording.reader import Recording
from pliant.results.earth import place_on_earth, summary_of
from pliant.results.known_scale import Scale
from pliant.results.run import Run


def from_gps(recording: Recording, run: Run) -> Scale:
    """By the longest segment, as a whole.  Raises ResultError."""
    history = run.history
    longest = history.longest_segment()
    poses = {frame: pose for frame, pose in history.final().items() if pose[0] == longest}
    if not poses:
        raise ResultError(f"{recording.path}: the run has no poses")
    fit = place_on_earth(recording, history.trajectory(poses), oriented=False)
    return Scale(metres_per_unit=fit.metres_per_unit, sigma=fit.scale_sigma, source=summary_of(fit))
