"""Behind ``pliant run``."""
