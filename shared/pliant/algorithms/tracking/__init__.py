"""Dense tracking of curvature extrema informed by a dominant flow (VITAMIN-E, section 2)."""
