"""Behind ``pliant replay``: services again on what was recorded, and recordings as if live."""
