"""Adjustment of a window, a segment, ordinary frames and the whole map; loop closure."""
