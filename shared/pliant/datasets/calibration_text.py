"""Calibration files as text, whatever they are written in: Latin-1, UTF-16, COLMAP's binary."""

import struct
from pathlib import Path

from pliant.errors import CalibrationError
from pliant.text_files import decoded

_MAX_BYTES = 1 << 20
_MAX_JSON_BYTES = 1 << 26
"""A transforms.json has the pose of every image."""
_COLMAP_MODELS = (
    *(("SIMPLE_PINHOLE", 3), ("PINHOLE", 4), ("SIMPLE_RADIAL", 4), ("RADIAL", 5), ("OPENCV", 8)),
    *(("OPENCV_FISHEYE", 8), ("FULL_OPENCV", 12), ("FOV", 5), ("SIMPLE_RADIAL_FISHEYE", 4)),
    *(("RADIAL_FISHEYE", 5), ("THIN_PRISM_FISHEYE", 12), ("RAD_TAN_THIN_PRISM_FISHEYE", 16)),
    *(("SIMPLE_DIVISION", 4), ("DIVISION", 5), ("SIMPLE_FISHEYE", 3), ("FISHEYE", 4)),
    *(("EUCM", 6), ("EQUIRECTANGULAR", 2)),
)
"""Name and number of parameters by COLMAP's model id."""


def calibration_text(file: Path) -> str:
    """The text of a file; of a COLMAP cameras.bin that of its cameras.txt.

    Raises CalibrationError, and OSError if it cannot be read.
    """
    limit = _MAX_JSON_BYTES if file.suffix == ".json" else _MAX_BYTES
    if file.is_file() and file.stat().st_size > limit:
        raise CalibrationError(f"{file}: too large for a calibration file; is it the right one?")
    data = file.read_bytes()
    if file.suffix == ".bin":
        return _colmap_text(data, file)
    try:
        text = decoded(data)
    except UnicodeDecodeError:
        text = data.decode("latin-1")  # what editors of old write
    if "\0" in text or any(0x7F <= ord(letter) < 0xA0 for letter in text):
        raise CalibrationError(f"{file}: not a text file")
    return text


def _colmap_text(data: bytes, file: Path) -> str:
    lines, at = list[str](), 8
    try:
        (count,) = struct.unpack_from("<Q", data)
        for _ in range(count):
            number, model, width, height = struct.unpack_from("<IiQQ", data, at)
            name, parameters = _COLMAP_MODELS[model] if model >= 0 else ("", 0)
            values = struct.unpack_from(f"<{parameters}d", data, at + 24)
            at += 24 + 8 * parameters
            lines.append(f"{number} {name} {width} {height} {' '.join(map(repr, values))}")
    except (struct.error, IndexError):
        lines.clear()
    if not lines or at != len(data):
        raise CalibrationError(f"{file}: not a cameras.bin of COLMAP: export the model as text")
    return "\n".join(lines)
