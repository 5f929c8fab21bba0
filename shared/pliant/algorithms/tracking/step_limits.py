"""The limits and switches of a tracking step, as columns of the two arrays that kernels take."""

(
    PREDICTION_WEIGHT,
    PREDICTION_SIGMA,
    MAX_CORRECTION,
    MUTUAL_GATE,
    MIN_CURVATURE,
    MIN_ZNCC,
    REFRESH_ZNCC,
    MIN_RESIDUAL,
    MIN_STRENGTH,
    EXTREMUM_GATE,
    COAST_GATE,
    BACKWARD_GATE,
) = range(12)
"""Columns of the limits, float32 each: see the fields of TrackingParameters."""
LIMITS = 12
MUTUAL_CHECK, SUBPIXEL, PATCH_REFINEMENT, PATCH_ITERATIONS, COAST_FRAMES = range(5)
"""Columns of the switches, int32 each."""
SWITCHES = 5
