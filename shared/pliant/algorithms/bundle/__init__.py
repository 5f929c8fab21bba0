"""Bundle adjustment (VITAMIN-E section 3): problems and parameters; the solvers beside them.

``schur`` adjusts cameras, points and a calibration together, ``subspace`` by halves.
"""
