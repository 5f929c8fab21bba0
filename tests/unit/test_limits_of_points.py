"""How many observations make a point, by how many points a frame sees."""

from pliant.algorithms.slam.active.frame_pose import limits_of_points
from pliant.algorithms.slam.parameters import MappingParameters


def test_where_few_points_are_left_two_observations_make_one():
    parameters = MappingParameters()
    least = parameters.start.min_points
    assert limits_of_points(least, parameters) == parameters.point
    few = limits_of_points(least - 1, parameters)
    assert few.min_observations == 2
    assert few.min_parallax_deg == parameters.point.min_parallax_deg
