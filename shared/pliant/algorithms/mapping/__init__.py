"""The map: how it starts and grows, and the pose of every frame in it."""
