"""Depth at every pixel of a keyframe, from the images of the keyframes around it."""
