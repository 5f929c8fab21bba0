"""What hosts a service: its process, its bus, its launcher, its clock."""
