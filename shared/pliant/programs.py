"""How programs in Python are started."""

import sys

PYTHON = (sys.executable, "-P")
"""Without modules of the current folder, where a signal.py would replace Python's own."""
