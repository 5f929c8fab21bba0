"""Cameras, rest shape and displacements of a scene that deforms, adjusted together."""
