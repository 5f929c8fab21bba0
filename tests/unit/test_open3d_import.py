"""Where open3d is missing or cannot be loaded, the remedy is named."""

import sys
from collections.abc import Iterator
from types import ModuleType

import pytest

from pliant.errors import PliantError
from pliant.export import open3d_import
from pliant.export.open3d_import import require_open3d
from pliant_services.cli.doctor import diagnose


@pytest.fixture(autouse=True)
def _forgotten() -> Iterator[None]:
    require_open3d.cache_clear()
    yield
    require_open3d.cache_clear()


@pytest.mark.parametrize(
    ("raised", "said"),
    [
        (
            ModuleNotFoundError("no", name="open3d"),
            r"not installed: pip install 'pliant\[open3d\]'",
        ),
        (ModuleNotFoundError("no", name="dash"), "lacks dash"),
        (OSError("libGL.so.1: cannot open shared object file"), "libGL.so.1.*libgl1"),
    ],
)
def test_without_open3d_the_remedy_is_named(
    raised: Exception, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(name: str) -> None:
        raise raised

    monkeypatch.setattr(open3d_import.importlib, "import_module", fail)
    with pytest.raises(PliantError, match=said):
        require_open3d()


def test_doctor_finds_open3d_whatever_its_package_is_called(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    named_otherwise = ModuleType("open3d")
    named_otherwise.__version__ = "9.8.7"  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "open3d", named_otherwise)
    (found,) = [finding for finding in diagnose() if finding.what == "open3d"]
    assert (found.grade, found.detail) == ("ok", "9.8.7")
    monkeypatch.setitem(sys.modules, "open3d", None)
    (found,) = [finding for finding in diagnose() if finding.what == "open3d"]
    assert found.grade == "warning"
    assert "pip install 'pliant[open3d]'" in found.detail
