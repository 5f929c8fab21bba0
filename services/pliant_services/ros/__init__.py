"""Behind ``pliant ros``."""
