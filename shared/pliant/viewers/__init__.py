"""Viewers: the conversion from messages to drawings, and the programs that show them."""
