"""Where open3d comes in, and what to do where it does not."""

import importlib
from functools import cache
from typing import Any

from pliant.errors import PliantError

_PACKAGE = "pip install 'pliant[mesh]' (or open3d-cpu: smaller, Linux x86_64 only)"
_LIBRARIES = "libegl1 libgl1 libx11-6 libusb-1.0-0"


class FusionError(PliantError):
    """The mesh cannot be fused here; the rest of the pipeline can go on without it."""


@cache
def require_open3d() -> Any:
    """The module open3d.  It takes 1-3 s to import, so it is imported where it is first used.

    Raises FusionError, which names the remedy, where it is missing or cannot be loaded.
    """
    try:
        return importlib.import_module("open3d")
    except ModuleNotFoundError as error:
        if error.name != "open3d":
            raise FusionError(
                f"open3d cannot be imported, it lacks {error.name}: {_PACKAGE}"
            ) from error
        raise FusionError(f"the mesh needs open3d, which is not installed: {_PACKAGE}") from error
    except (ImportError, OSError) as error:
        raise FusionError(
            f"open3d is installed but cannot be loaded ({error}): install the system's "
            f"libraries, on Debian and Ubuntu: apt-get install {_LIBRARIES}"
        ) from error
