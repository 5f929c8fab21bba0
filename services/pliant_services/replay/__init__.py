"""Behind ``pliant replay``: services run again on a recording, and recordings as if live."""
