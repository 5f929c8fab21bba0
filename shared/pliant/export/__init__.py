"""What a result becomes for other programs and for the eye: ``pliant export``."""
