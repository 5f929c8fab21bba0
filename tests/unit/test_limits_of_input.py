"""No input is expanded or printed without a limit."""

import ast
from pathlib import Path

import cv2
import numpy as np
import pytest

import pliant
import pliant_services
from pliant.config import load_config
from pliant.datasets import open_source
from pliant.datasets.calibration import calibration_from_yaml
from pliant.datasets.calibration_files import read_calibration
from pliant.datasets.source_spec import SourceSpec
from pliant.errors import CalibrationError, ConfigError, DatasetError
from pliant.wording import shortened, shown
from pliant.yaml_text import YamlError, load_yaml

CAMERA = "width: 64\nheight: 48\nfy: 60\ncx: 32\ncy: 24\n"


def bomb(levels: int, key: str) -> str:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    for n in range(1, levels):
        lines.append(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]")
    return "\n".join([*lines, f"{key}: *a{levels - 1}"]) + "\n"


@pytest.mark.parametrize("levels", [3, 6, 9, 30])
def test_aliases_that_stand_for_many_values_end_in_a_short_line(
    levels: int, tmp_path: Path
) -> None:
    text = CAMERA + bomb(levels, "fx")
    file = tmp_path / "calib.yaml"
    file.write_text(text)
    for read in (lambda: calibration_from_yaml(text), lambda: read_calibration(file, (64, 48))):
        with pytest.raises(CalibrationError) as caught:
            read()
        assert len(str(caught.value)) < 500 + len(str(file))
    config = tmp_path / "config.yaml"
    config.write_text(bomb(levels, "seed"))
    with pytest.raises(ConfigError) as refused:
        load_config(config)
    assert len(str(refused.value)) < 300 + len(str(config))


@pytest.mark.parametrize(
    "text",
    [
        "a: &a [*a]",
        "a: &a {b: *a}",
        "[" * 5000,
        "a: !!timestamp x",
        "a: !!int ''",
        "a: !!bool x",
        "a: !!float x",
        "a: !!binary ä",
        "a: !!python/object:os.system {}",
        "a: !!set [1]",
        "? [1]\n: 2",
        "a: &m {k: v}\nb: {<<: *nothing}",
        "a: b: c",
        "\0",
        "- " * 3000 + "1",
    ],
)
def test_yaml_that_cannot_be_read_is_one_short_line(text: str) -> None:
    with pytest.raises(YamlError) as caught:
        load_yaml(text)
    assert len(str(caught.value)) < 300
    assert "\n" not in str(caught.value)
    with pytest.raises(CalibrationError):
        calibration_from_yaml(f"k: 1\n{text}" if text[0] != "\0" else text)


def test_yaml_with_a_few_aliases_is_read() -> None:
    assert load_yaml("a: &id001 [1, 2]\nb: *id001\n") == {"a": [1, 2], "b": [1, 2]}
    assert load_yaml("") is None


def test_what_is_quoted_is_short() -> None:
    for value in ("x" * 10**6, ["x" * 10**5] * 10**5, {"k": {"l": ["y" * 999] * 99}}, 10**4000):
        assert len(shown(value)) <= 120
    assert shown("cam0") == "'cam0'"
    assert shortened("a" * 100, 11) == "aaaa...aaaa"
    assert shortened("short") == "short"


@pytest.mark.parametrize("package", [pliant, pliant_services])
def test_nothing_is_quoted_without_a_limit(package: object) -> None:
    """``!r`` in a message prints whatever a file or the network gives."""
    allowed = {"formats/colmap.py", "__init__.py", "api/result.py"}
    (root,) = package.__path__  # type: ignore[attr-defined]
    found: list[str] = []
    for path in Path(root).rglob("*.py"):
        name = str(path.relative_to(root))
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            is_repr = isinstance(node, ast.FormattedValue) and node.conversion == ord("r")
            if is_repr and name not in allowed:
                found.append(f"{name}:{node.lineno}")
    assert found == []


def test_a_line_of_a_list_is_quoted_in_part(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((20, 20), np.uint8))
    for line in (f"{'9' * 10**5} a.png", f"1 {'b' * 10**5}.png", "c" * 10**5, f"{'n' * 10**5} a"):
        (tmp_path / "rgb.txt").write_text(line)
        with pytest.raises(DatasetError) as caught:
            open_source(SourceSpec(location=str(tmp_path), fov_deg=60.0))
        assert len(str(caught.value)) < 400 + len(str(tmp_path))


def huge_png(side: int) -> bytes:
    """A PNG that says that it is as large, without the pixels."""
    import struct
    import zlib

    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    header = struct.pack(">IIBBBBB", side, side, 8, 0, 0, 0, 0)
    pixels = zlib.compress(b"\0" * 1000)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")
    )


def test_an_image_with_a_huge_size_in_its_header_is_one_line(tmp_path: Path) -> None:
    folder = tmp_path / "images"
    folder.mkdir()
    for name in ("0.png", "1.png"):
        cv2.imwrite(str(folder / name), np.zeros((20, 20), np.uint8))
    mask = tmp_path / "mask.png"
    mask.write_bytes(huge_png(60000))
    with pytest.raises(DatasetError, match="OpenCV cannot read this image, or it exceeds"):
        open_source(SourceSpec(location=str(folder), fov_deg=60.0, mask=mask))
    (folder / "0.png").write_bytes(huge_png(60000))
    assert open_source(SourceSpec(location=str(folder), fov_deg=60.0)).calibration.width == 20
