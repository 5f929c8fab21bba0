"""Surfels that move on their own, followed through the images of one camera (DSDT)."""
