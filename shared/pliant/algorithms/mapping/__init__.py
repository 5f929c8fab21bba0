"""The map: its start, its growth frame by frame, and the pose of every frame in it."""
