"""A short form of ``scripts/bench kidnappings``: a camera that is suddenly elsewhere in its map."""

import pytest
from benchmarks.played import Reel
from benchmarks.sessions import frames_until_found, kidnapped

from pliant.config import load_config


@pytest.mark.slow
def test_a_kidnapped_camera_is_found_at_once_and_where_it_is() -> None:
    """From the dark, and by a cut from image to image, after which some tracks go on at what looks
    alike."""
    reel = Reel("built-in:room?width=320&frames=150&colour=0", load_config())
    order, arrivals = kidnapped(reel, 1.5, 5)
    cuts, after = kidnapped(reel, 0.0, 5)
    further = len(order) - len(reel)
    arrivals += [range(seen.start + further, seen.stop + further) for seen in after]
    came = reel.play(order + cuts[len(reel) :])
    assert all(until is not None and until <= 5 for until in frames_until_found(came, arrivals))
    assert came.segments == 1
    for poses in (came.final, came.online):
        assert came.errors_m(poses).max() < 0.05
