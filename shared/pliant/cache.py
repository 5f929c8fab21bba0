"""Where Pliant keeps what it can make again: rendered sequences, stamps of compiled kernels."""

import os
from pathlib import Path


def cache_folder() -> Path:
    """PLIANT_CACHE_DIR, else the user's cache folder."""
    own = os.environ.get("PLIANT_CACHE_DIR")
    if own:
        return Path(own)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "pliant"
