"""The map: its start, its growth frame by frame, and the pose of every frame in it."""

from pliant.algorithms.mapping.mapper import Mapper
from pliant.algorithms.mapping.parameters import MappingParameters
from pliant.algorithms.mapping.warm_up import warm_up

__all__ = ["Mapper", "MappingParameters", "warm_up"]
