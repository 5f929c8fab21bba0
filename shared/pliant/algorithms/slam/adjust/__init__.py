"""Adjustment of a window, a segment and ordinary frames."""
