"""One of the scenes that ``scripts/bench deceiving`` renders: none is taken for another place."""

import pytest
from benchmarks.deceiving import run
from benchmarks.deceiving_scenes import floor, room_with, rooms

from pliant.config import load_config

CONFIG = load_config(overrides=["bundle_adjustment.window.final_iterations=2"])
"""More of them move the map by far less than what lies between two places."""


@pytest.mark.slow
def test_of_two_rendered_rooms_neither_is_taken_for_the_other() -> None:
    """Alike but for a picture, each seen again from the dark."""
    came = dict(run(rooms(0, both=True), CONFIG, 0))
    assert len(came) == 3
    for one in came.values():
        assert one.confirmed >= 2  # it does deceive
        assert one.joined == 0
        assert one.wrong == one.astray == []
    assert came["the second"].found == came["the second"].frames


@pytest.mark.slow
def test_no_part_of_a_chequered_floor_is_taken_for_another() -> None:
    """Not by chance, and not by a frame of many, for the image itself says that it cannot tell."""
    for one in dict(run(floor(0), CONFIG, 0)).values():
        assert one.confirmed == 0
        assert one.joined == 0
        assert one.wrong == []
        assert one.found == 0


@pytest.mark.slow
def test_a_room_is_where_most_of_it_is_and_not_where_its_picture_hangs_now() -> None:
    """Most corners are the picture's, and agree with each other."""
    came = dict(run(room_with(0, "picture"), CONFIG, 0))
    again, beside = came["the room again"], came["first a wall beside"]
    assert again.wrong == beside.wrong == []
    assert again.found >= 0.9 * again.frames
    assert beside.joined == 0  # by the picture, which is all that both have in common at first


@pytest.mark.slow
def test_a_segment_joins_a_room_in_which_some_things_stand_elsewhere() -> None:
    one = dict(run(room_with(0, "thing 1", "poster 0"), CONFIG, 0))["first a wall beside"]
    assert one.wrong == []
    assert one.joined == 1
    assert one.found == one.frames
