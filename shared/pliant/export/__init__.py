"""``pliant export``: results for other programs and as pictures."""
