"""Pliant's processes, what hosts them, and the command line."""

import pliant  # noqa: F401  (fixes the arithmetic before any module loads numpy)
