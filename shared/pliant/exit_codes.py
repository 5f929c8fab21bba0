"""The exit codes of the command line and of its services."""

DONE, FAILED, USAGE, INCOMPLETE, INTERRUPTED = 0, 1, 2, 3, 130
"""INCOMPLETE: without a map, with frames broken or missing, or of a source that failed early."""
