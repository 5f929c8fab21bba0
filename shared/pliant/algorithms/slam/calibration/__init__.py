"""The calibration of the camera, as the images tell it."""
