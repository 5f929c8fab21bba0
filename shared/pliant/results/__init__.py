"""A result folder: what a run leaves, written from its recording and read again."""
