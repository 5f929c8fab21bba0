"""Pliant: trajectory, dense map and deforming surfaces from the video of one camera."""

__version__ = "0.1.0"
