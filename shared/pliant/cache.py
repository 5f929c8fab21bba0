"""The folder for data that can be made again: rendered sequences, compiled kernels."""

import os
from pathlib import Path


def cache_folder() -> Path:
    """PLIANT_CACHE_DIR, else the user's cache folder."""
    own = os.environ.get("PLIANT_CACHE_DIR")
    if own:
        return Path(own)
    home = os.path.expanduser("~")
    home = "/" if home == "~" else home  # unknown: users without one have root's
    return Path(os.environ.get("XDG_CACHE_HOME") or Path(home, ".cache")) / "pliant"
