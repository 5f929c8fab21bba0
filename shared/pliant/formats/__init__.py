"""Open file formats: what other tools read and write."""
