"""From keyframes to meshes: a live one that follows the map, and a final one at the end."""
