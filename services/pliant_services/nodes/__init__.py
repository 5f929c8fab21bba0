"""The services: one short file each, which says in its first lines what it reads and publishes."""
