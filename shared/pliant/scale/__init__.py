"""The length of a map unit of a rigid run, measured by a known length in the scene."""
