"""Pliant: trajectory, dense map and deforming surfaces from the video of one camera."""

import os

from pliant import arithmetic

arithmetic.fix()
# FFmpeg is silent: our own line says what is wrong with a video.  Read at OpenCV's first one.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")

__version__ = "0.1.0"
