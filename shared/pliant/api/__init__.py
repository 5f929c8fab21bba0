"""The names of ``import pliant``: runs, their results, and mapping image by image."""
