"""Behind ``pliant batch``: every source of a folder through ``pliant run``."""
