"""The renderer of textured scenes: exact poses, depth and surface.  Arrays in, arrays out."""
