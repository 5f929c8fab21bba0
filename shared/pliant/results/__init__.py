"""A result folder: the output of a run, written from its recording and read again."""
