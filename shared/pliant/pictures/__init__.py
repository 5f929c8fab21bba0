"""Tracks, maps and meshes drawn without any GUI library."""
