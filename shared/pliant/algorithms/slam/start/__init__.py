"""The first map of a sequence."""
