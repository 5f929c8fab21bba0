"""Bundle adjustment (VITAMIN-E section 3): problems, parameters and solvers.

``schur`` adjusts cameras, points and a calibration together, ``subspace`` alternates between them.
"""
