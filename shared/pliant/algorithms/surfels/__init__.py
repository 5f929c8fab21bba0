"""Independently moving surfels, tracked through the images of one camera (DSDT)."""
