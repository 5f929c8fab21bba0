"""Pliant's processes: one short file each, and the launcher that supervises them."""
