"""The host of a service: its process, its bus, its launcher, its clock."""
