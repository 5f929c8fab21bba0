"""From the points of keyframes to a mesh of the scene (VITAMIN-E, section 4)."""
