"""Solvers of poses, points and calibrations: arrays in, arrays out."""
