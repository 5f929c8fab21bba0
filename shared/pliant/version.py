"""The release, for whoever writes it down: loads nothing else."""

__version__ = "0.1.0"
