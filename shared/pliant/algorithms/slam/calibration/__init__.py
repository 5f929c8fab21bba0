"""The calibration of the camera, as the images determine it."""
