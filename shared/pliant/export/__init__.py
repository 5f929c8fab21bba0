"""Open file formats and pictures: what is written for other tools and for the eye."""
