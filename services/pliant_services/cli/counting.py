"""Progress of a command on a terminal."""

import sys


def show_progress(what: str, done: int, total: int) -> None:
    """One line of a terminal that counts; total below 1: it is unknown."""
    if sys.stderr.isatty():
        end = "\n" if done == total else ""
        of = f" of {total}" if total > 0 else ""
        print(f"\r{what} {done}{of} ", end=end, file=sys.stderr, flush=True)
