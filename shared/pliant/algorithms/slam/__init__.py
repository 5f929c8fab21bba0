"""Simultaneous localisation and mapping: poses and landmarks from tracks.

Packages, each of which imports only those before it:

estimate: solvers of a pose, a window, all keyframes, a graph of similarities.
map: landmarks, keyframes, and their links to tracks.
calibration: the camera's calibration as the images show it, its readout, its changing focal length.
locate: the pose of one frame in the map.
adjust: adjustment of a window, a segment, ordinary frames.
start: the first map.
places: place recognition, loops, relocalisation.
store: maps of earlier segments and sessions.

The modules beside them are the flow of a frame.  Begin with ``mapper.py``.
"""
