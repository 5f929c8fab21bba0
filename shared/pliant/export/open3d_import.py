"""The one place where open3d comes in, and what to do where it does not.

Only a few exports and comparisons need it: no run does.
"""

import importlib
from functools import cache
from typing import Any

from pliant.errors import PliantError

_PACKAGE = "pip install 'pliant[open3d]'"
_LIBRARIES = "libegl1 libgl1 libx11-6 libusb-1.0-0"
OPEN3D_REMEDY = f"{_PACKAGE}; on Debian and Ubuntu also apt-get install {_LIBRARIES}"


class Open3dError(PliantError):
    """open3d is missing, or cannot be loaded."""


@cache
def require_open3d() -> Any:
    """The module open3d.  It takes 1-3 s to import, so it is imported where it is first used.

    Raises Open3dError, which names the remedy, where it is missing or cannot be loaded.
    """
    try:
        return importlib.import_module("open3d")
    except ModuleNotFoundError as error:
        if error.name != "open3d":
            raise Open3dError(
                f"open3d cannot be imported, it lacks {error.name}: {_PACKAGE}"
            ) from error
        raise Open3dError(f"this needs open3d, which is not installed: {_PACKAGE}") from error
    except (ImportError, OSError) as error:
        raise Open3dError(
            f"open3d is installed but cannot be loaded ({error}): install the system's "
            f"libraries, on Debian and Ubuntu: apt-get install {_LIBRARIES}"
        ) from error
