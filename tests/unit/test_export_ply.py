"""PLY files: exact bytes out, nothing trusted in."""

from pathlib import Path

import numpy as np
import pytest

from pliant.errors import ResultError
from pliant.formats.ply import read_ply, write_ply

POINTS = np.array([[0, 1, 2], [3, 4, 5], [6, 7, 8.5]], np.float32)
COLOURS = np.array([[1, 2, 3], [4, 5, 6], [255, 0, 9]], np.uint8)
FACES = np.array([[0, 1, 2]], np.int32)


def test_exact_bytes(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", POINTS[:1], COLOURS[:1])
    header = (
        b"ply\nformat binary_little_endian 1.0\nelement vertex 1\n"
        b"property float x\nproperty float y\nproperty float z\n"
        b"property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n"
    )
    body = np.array([0, 1, 2], "<f4").tobytes() + bytes([1, 2, 3])
    assert (tmp_path / "a.ply").read_bytes() == header + body


@pytest.mark.parametrize("colours", [None, COLOURS])
@pytest.mark.parametrize("normals", [None, POINTS[::-1].copy()])
@pytest.mark.parametrize("faces", [None, FACES, FACES[:0]])
def test_round_trip(
    tmp_path: Path,
    colours: np.ndarray | None,
    normals: np.ndarray | None,
    faces: np.ndarray | None,
) -> None:
    write_ply(tmp_path / "a.ply", POINTS, colours, normals=normals, faces=faces)
    data = read_ply(tmp_path / "a.ply")
    assert np.array_equal(data.points, POINTS)
    for found, given in ((data.colours, colours), (data.normals, normals), (data.faces, faces)):
        assert (found is None) == (given is None)
        assert given is None or np.array_equal(found, given)


def test_no_points(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", POINTS[:0], COLOURS[:0])
    assert read_ply(tmp_path / "a.ply").points.shape == (0, 3)


def test_wrong_arrays_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="colours"):
        write_ply(tmp_path / "a.ply", POINTS, COLOURS[:2])
    with pytest.raises(ValueError, match="not finite"):
        write_ply(tmp_path / "a.ply", POINTS * np.float32(np.nan))
    with pytest.raises(ValueError, match="corner"):
        write_ply(tmp_path / "a.ply", POINTS, faces=FACES + 1)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"vertex 3", b"vertex 4", "promises"),
        (b"vertex 3", b"vertex 99999999999", "promises"),
        (b"vertex 3", b"vertex -1", "not understood"),
        (b"little", b"big___", "only binary_little_endian"),
        (b"property float x", b"property half x", "not understood"),
        (b"property float y", b"property float x", "twice"),
        (b"property float x", b"property float w", "no x, y, z"),
        (b"end_header\n", b"", "not a PLY"),
        (b"face 1", b"face 2", "promises"),
        (b"ply\n", b"plx\n", "not a PLY"),
    ],
)
def test_broken_files_are_one_clear_line(
    tmp_path: Path, old: bytes, new: bytes, message: str
) -> None:
    file = tmp_path / "a.ply"
    write_ply(file, POINTS, COLOURS, faces=FACES)
    file.write_bytes(file.read_bytes().replace(old, new, 1))
    with pytest.raises(ResultError, match=message) as caught:
        read_ply(file)
    assert "\n" not in str(caught.value)


def test_bad_corner_and_short_file(tmp_path: Path) -> None:
    file = tmp_path / "a.ply"
    write_ply(file, POINTS, faces=FACES)
    data = file.read_bytes()
    file.write_bytes(data[:-4] + np.array([7], "<i4").tobytes())
    with pytest.raises(ResultError, match="corner"):
        read_ply(file)
    file.write_bytes(data[:-1])
    with pytest.raises(ResultError, match="promises"):
        read_ply(file)
    with pytest.raises(ResultError, match="cannot be read"):
        read_ply(tmp_path / "absent.ply")
