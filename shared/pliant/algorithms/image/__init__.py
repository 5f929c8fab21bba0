"""Kernels on grey levels: smaller images, and the alignment of small patches."""
