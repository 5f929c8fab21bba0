"""Behind ``pliant calibrate``: with a board, without one, and the board to print."""
