"""Runs for the eye: one fold from messages to drawings, and the programs that show them."""
