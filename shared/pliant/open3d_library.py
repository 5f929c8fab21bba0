"""Open3D, loaded only where it is used: it takes a second, 200 MB, and libraries of the system."""

import ctypes
import sys
from importlib import import_module
from typing import Any

from pliant.errors import PliantError

SYSTEM_PACKAGES = "libegl1 libgl1 libx11-6 libusb-1.0-0"
"""Packages of Debian and Ubuntu that `import open3d` needs."""

OPEN3D_IS_FOR = "--watertight, `pliant view --open3d` and `to_open3d()`"


class Open3dError(PliantError):
    """Open3D is not installed, or a library of the system that it needs is not."""


def load_open3d() -> Any:
    """The module ``open3d``.  Raises Open3dError with what to install."""
    try:
        return _imported()
    except ModuleNotFoundError as error:
        raise Open3dError(
            f"this needs Open3D, which is not installed ({error}): "
            "pip install --force-reinstall pliant"
        ) from None
    except (ImportError, OSError) as error:
        raise Open3dError(f"Open3D cannot be loaded ({_line(error)}): {_remedy()}") from None


def _imported() -> Any:
    try:
        return import_module("open3d")
    except ImportError as error:
        if "libusb" not in str(error) or not _libusb_of_pip():
            raise
        return import_module("open3d")


def _libusb_of_pip() -> bool:
    """Whether the package libusb-package, which needs no root, is there: its library is loaded."""
    try:
        package: Any = import_module("libusb_package")
        ctypes.CDLL(str(package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    except (ImportError, OSError):
        return False
    return True


def _remedy() -> str:
    if sys.platform == "linux":
        return f"sudo apt install {SYSTEM_PACKAGES}"
    return "pip install --force-reinstall open3d"


def _line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
