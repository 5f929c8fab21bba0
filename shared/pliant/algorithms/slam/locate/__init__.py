"""The pose of one frame in the map."""
