"""The services: one short file each, whose first lines have its inputs and outputs."""
