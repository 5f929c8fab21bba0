"""Behind ``pliant mesh``, and the mesh of a run whose services may be started again."""
