"""Open3D, and what is said where it cannot be loaded."""

import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from pliant import open3d_library
from pliant.open3d_library import Open3dError, load_open3d
from pliant_services.cli import doctor


def broken(folder: Path, patch: pytest.MonkeyPatch, error: str) -> None:
    """An Open3D whose import fails, as it does where a library of the system is missing."""
    (folder / "open3d").mkdir()
    (folder / "open3d" / "__init__.py").write_text(f"raise ImportError({error!r})\n")
    for name in [name for name in sys.modules if name.split(".")[0] == "open3d"]:
        patch.delitem(sys.modules, name)
    patch.syspath_prepend(str(folder))


@pytest.mark.parametrize("library", ["libGL.so.1", "libEGL.so.1", "libusb-1.0.so.0"])
def test_a_missing_library_is_one_line_with_what_to_install(
    library: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "libusb_package", None)
    broken(tmp_path, monkeypatch, f"{library}: cannot open shared object file")
    with pytest.raises(Open3dError) as caught:
        load_open3d()
    said = str(caught.value)
    assert library in said
    assert "\n" not in said
    if sys.platform == "linux":
        assert "sudo apt install libegl1 libgl1 libx11-6 libusb-1.0-0" in said
    (found,) = (f for f in doctor.diagnose() if f.what == "open3d")
    assert (found.grade, said in found.detail) == ("warning", True)


def test_libusb_may_come_from_pip(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without root: `pip install libusb-package`; its library is loaded before Open3D."""
    of_pip = SimpleNamespace(get_library_path=lambda: "of pip/libusb-1.0.so")
    monkeypatch.setitem(sys.modules, "libusb_package", of_pip)
    loaded: list[str] = []
    monkeypatch.setattr(open3d_library.ctypes, "CDLL", lambda path, mode: loaded.append(path))
    broken(tmp_path, monkeypatch, "libusb-1.0.so.0: cannot open shared object file")
    with pytest.raises(Open3dError):
        load_open3d()
    assert loaded == ["of pip/libusb-1.0.so"]


def test_what_is_not_installed_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(Open3dError, match="pip install"):
        load_open3d()
