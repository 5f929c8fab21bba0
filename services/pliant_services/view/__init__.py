"""Behind ``pliant view``."""
