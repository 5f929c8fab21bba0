"""Places that were seen before: described, looked up, and verified."""
