"""The segment that the camera is in, and the pose and focal length of a frame in it."""
