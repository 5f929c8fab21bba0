"""Inertial and satellite measurements, and what they say about a finished trajectory."""
