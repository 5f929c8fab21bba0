"""Pliant: trajectory, dense map and deforming surfaces from the video of one camera."""

from pliant import arithmetic

arithmetic.fix()

__version__ = "0.1.0"
