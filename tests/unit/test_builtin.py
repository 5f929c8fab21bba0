"""Built-in sequences: the folder's format, the cache, and what users get wrong."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from pliant.cache import cache_folder
from pliant.datasets import builtin
from pliant.datasets.base import is_builtin
from pliant.datasets.builtin import SequenceOptions, builtin_folder, parse_builtin
from pliant.errors import DatasetError

SMALL = "built-in:tiny?frames=3&width=64"


def contents(folder: Path) -> dict[str, bytes]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return builtin_folder(SMALL, cache=tmp_path_factory.mktemp("cache"))


def test_the_folder_is_a_dataset_like_the_others(folder: Path):
    calibration = yaml.safe_load((folder / "calib.yaml").read_text())
    assert (calibration["width"], calibration["height"]) == (64, 48)
    assert calibration["model"] == "pinhole"
    listed = [line.split() for line in (folder / "rgb.txt").read_text().splitlines()[1:]]
    assert [line[0] for line in listed] == ["0.000000000", "0.033333333", "0.066666666"]
    depths = [line.split() for line in (folder / "depth.txt").read_text().splitlines()[1:]]
    for (_, image_file), (_, depth_file) in zip(listed, depths, strict=True):
        image = cv2.imread(str(folder / image_file), cv2.IMREAD_UNCHANGED)
        depth = cv2.imread(str(folder / depth_file), cv2.IMREAD_UNCHANGED)
        assert (image.shape, image.dtype) == ((48, 64), np.uint8)
        assert (depth.shape, depth.dtype) == ((48, 64), np.uint16)
        metres = depth * calibration["depth_scale"]
        assert metres.min() > 0.3
        assert 0.5 * calibration["depth_scale"] / metres.min() < 5e-4
    poses = np.loadtxt(folder / "groundtruth.txt")
    assert poses.shape == (3, 8)
    np.testing.assert_allclose(np.linalg.norm(poses[:, 4:], axis=1), 1.0, atol=1e-8)


def test_the_surface_is_at_the_given_depth(folder: Path):
    data = (folder / "surface.ply").read_bytes()
    header, _, body = data.partition(b"end_header\n")
    count = int(header.split(b"element vertex ")[1].split()[0])
    vertices = np.frombuffer(body, "<f4").reshape(count, 6)
    np.testing.assert_allclose(np.linalg.norm(vertices[:, 3:], axis=1), 1.0, atol=1e-5)
    x, y, z = vertices[:, :3].T
    on_table = (np.abs(z) < 1e-5) & (np.hypot(x, y) < 0.75)
    assert on_table.sum() > 20
    np.testing.assert_allclose(vertices[on_table, 3:], np.tile([0, 0, 1], (on_table.sum(), 1)))


def test_rendering_twice_gives_the_same_bytes(folder: Path, tmp_path: Path):
    again = builtin_folder(SMALL, cache=tmp_path)
    assert again != folder
    assert contents(again) == contents(folder)


def test_the_cache_is_used_and_separated_by_options(folder: Path, monkeypatch):
    def fail(*_: object) -> None:
        raise AssertionError("rendered again")

    monkeypatch.setattr(builtin, "_render_into", fail)
    cache = folder.parent.parent
    assert builtin_folder(SMALL, cache=cache) == folder
    with pytest.raises(AssertionError, match="rendered again"):
        builtin_folder(SMALL + "&noise=0", cache=cache)


@pytest.mark.parametrize("interruption", [KeyboardInterrupt, RuntimeError])
def test_an_interrupted_rendering_leaves_nothing_behind(tmp_path: Path, interruption):
    def interrupt(what: str, done: int, _total: int) -> None:
        if what == "rendering frames" and done == 2:
            raise interruption

    with pytest.raises(interruption):
        builtin_folder(SMALL, cache=tmp_path, progress=interrupt)
    assert [path.suffix for path in (tmp_path / "sequences").iterdir()] == [".lock"]
    found = builtin_folder(SMALL, cache=tmp_path)
    assert len(list((found / "images").iterdir())) == 3


def test_what_a_killed_process_left_is_cleared_away(tmp_path: Path, folder: Path):
    left = tmp_path / "sequences" / f".{folder.name}.abc.partial"
    (left / "images").mkdir(parents=True)
    builtin_folder(SMALL, cache=tmp_path)
    assert not left.exists()


def test_progress_counts_up_to_the_end(tmp_path: Path):
    seen: list[tuple[str, int, int]] = []
    builtin_folder(SMALL, cache=tmp_path, progress=lambda *step: seen.append(step))
    assert seen[-1] == ("rendering frames", 3, 3)
    painted = [done for what, done, _ in seen if what == "painting textures"]
    assert painted == list(range(1, len(painted) + 1))


def test_a_given_path_is_followed_at_its_own_times(tmp_path: Path):
    file = tmp_path / "path.txt"
    lines = ["1.500000000 1.2 0 0.6 0 0 0 1", "1.550000000 1.3 0 0.6 0 0 0 1"]
    file.write_text("\n".join(lines) + "\n")
    source = f"built-in:tiny?width=64&path={file}&distortion=-0.1,0,0,0"
    out = builtin_folder(source, cache=tmp_path)
    poses = np.loadtxt(out / "groundtruth.txt")
    np.testing.assert_allclose(poses, [[float(x) for x in line.split()] for line in lines])
    calibration = yaml.safe_load((out / "calib.yaml").read_text())
    assert (calibration["model"], calibration["k1"]) == ("pinhole-radtan", -0.1)


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("built-in:attic", "built-in:room"),
        ("built-in:", "valid: built-in:room"),
        ("built-in:room?nois=2", "unknown option 'nois'; valid options: frames"),
        ("built-in:room?noise=loud", "noise=loud"),
        ("built-in:room?noise=-1", "noise=-1"),
        ("built-in:room?noise", "has no value"),
        ("built-in:room?distortion=1,2", "distortion"),
    ],
)
def test_wrong_sources_get_one_clear_line(source: str, message: str):
    with pytest.raises(DatasetError, match=message.replace("?", r"\?")) as caught:
        parse_builtin(source)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("built-in:tiny?frames=9999", "has only 40 frames"),
        ("built-in:tiny?distortion=-3,0,0,0", "folds the image"),
        ("built-in:tiny?path=/no/such/file", "/no/such/file"),
    ],
)
def test_impossible_options_get_one_clear_line(source: str, message: str, tmp_path: Path):
    with pytest.raises(DatasetError, match=message) as caught:
        builtin_folder(source, cache=tmp_path)
    assert "\n" not in str(caught.value)


def test_a_cache_that_cannot_be_written_is_named(tmp_path: Path):
    (tmp_path / "file").write_text("")
    with pytest.raises(DatasetError, match="PLIANT_CACHE_DIR"):
        builtin_folder(SMALL, cache=tmp_path / "file")


def test_the_place_of_the_cache(monkeypatch, tmp_path: Path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    monkeypatch.delenv("PLIANT_CACHE_DIR", raising=False)
    assert cache_folder() == tmp_path / "xdg" / "pliant"
    monkeypatch.setenv("PLIANT_CACHE_DIR", str(tmp_path / "own"))
    assert cache_folder() == tmp_path / "own"


def test_what_is_a_built_in_source():
    assert is_builtin("built-in:room")
    assert not is_builtin("room")
    options = parse_builtin("room?frames=60&noise=0&distortion=-0.2,0.05,0,0&colour=1")[1]
    assert options == SequenceOptions(
        frames=60, noise=0.0, distortion=(-0.2, 0.05, 0.0, 0.0), colour=True
    )
