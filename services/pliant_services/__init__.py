"""Pliant's processes, what hosts them, and the command line."""

from pliant import arithmetic

arithmetic.fix()  # before any module of these loads numpy
