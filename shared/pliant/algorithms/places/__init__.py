"""Places that were seen before: described, looked up, and what of them tells nothing."""
