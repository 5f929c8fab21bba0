"""Pliant's processes, what hosts them, and the command line."""
