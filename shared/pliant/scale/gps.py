"""The scale of a map from satellite fixes that came with its source."""

from pliant.errors import ResultError
from pliant.recording.reader import Recording
from pliant.results.earth import place_on_earth, scale_by
from pliant.results.known_scale import Scale
from pliant.results.run import Run


def from_gps(recording: Recording, run: Run) -> Scale:
    """By the longest segment, as a whole.  Raises ResultError."""
    history = run.history
    longest = history.longest_segment()
    trajectory = history.trajectory_in(longest, history.final())
    if not len(trajectory):
        raise ResultError(f"{recording.path}: the run has no poses")
    return scale_by(place_on_earth(recording, run, trajectory, oriented=False))
