"""Simultaneous localisation and mapping: poses and landmarks from tracks.

Packages, each of which imports only those before it:

estimate: solvers of a pose, a window, all keyframes, a graph of similarities.
map: landmarks, keyframes, and their links to tracks.
calibration: the camera's calibration as the images show it, its readout, its changing focal length.
locate: the pose of a camera from landmarks in its image.
adjust: adjustment of a window, a segment, ordinary frames, the whole map; loop closure.
start: the first map.
places: place recognition, relocalisation.
store: maps of earlier segments and sessions.
active: the segment that the camera is in, and the pose of a frame in it.
atlas: all segments and how they merge, the poses of all frames, and what is published of both.

Begin with ``mapper.py``.  Three classes process frames, each a ``FrameMapper``: ``Mapper``,
``Localiser`` in a loaded map, and ``BootstrapMapper`` of an unknown camera.
"""
