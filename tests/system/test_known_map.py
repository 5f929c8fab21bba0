"""``pliant run --map`` and ``pliant map``: sessions in the map that an earlier one has left."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from running import NO_MESH, TINY, assert_one_line, digests, in_this_process

import pliant as library
from pliant.algorithms.geometry import inverse, so3_log
from pliant.datasets import open_source
from pliant.datasets.rectifier import decode
from pliant.formats.tum import read_tum

pytestmark = pytest.mark.system


@pytest.fixture(scope="module")
def office(tiny_run: Path) -> Path:
    assert (tiny_run / "map.pliant").is_file()
    return tiny_run


def test_a_run_continues_in_a_map_and_replays(office: Path, tmp_path: Path) -> None:
    before = (office / "map.pliant").read_bytes()
    done = in_this_process("run", TINY, "--map", office, *NO_MESH, "--output", tmp_path / "today")
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "today" / "report.json").read_text())
    assert report["known_map"]["frames_in_it"] == report["frames_with_pose"] == report["frames"]
    assert report["known_map"]["looked"] == 0
    assert [segment["id"] for segment in report["segments"]] == [0]
    assert "in the loaded map" in done.stdout
    first = read_tum(office / "trajectory.txt").positions
    second = read_tum(tmp_path / "today" / "trajectory.txt").positions
    assert np.linalg.norm(first - second, axis=1).max() < 0.01  # one world, at one scale
    assert (office / "map.pliant").read_bytes() == before
    told = in_this_process("map", "info", tmp_path / "today")
    assert "sessions: 2" in told.stdout

    again = in_this_process("replay", tmp_path / "today", "--check", "--output", tmp_path / "again")
    assert again.returncode == 0, again.stdout
    assert "map/kept" in again.stdout
    kept = [tmp_path / name / "map.pliant" for name in ("today", "again")]
    assert kept[0].read_bytes() == kept[1].read_bytes()
    assert digests(tmp_path / "today") == digests(tmp_path / "again")


@pytest.mark.parametrize("source", [TINY, f"{TINY}?width=400"])
def test_a_run_only_localises(source: str, office: Path, tmp_path: Path) -> None:
    """Also with a larger camera than that of the map, and with few of the tracks that it has."""
    only = ("--map", office, "--localise", "--light", *NO_MESH)
    done = in_this_process("run", source, *only, "--output", tmp_path / "robot")
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "robot" / "report.json").read_text())
    assert report["frames_with_pose"] == report["frames"]
    assert report["keyframes"] == 0
    assert 1000 < report["median_tracks_per_frame"] <= 2000
    first = read_tum(office / "trajectory.txt").positions
    second = read_tum(tmp_path / "robot" / "trajectory.txt").positions
    assert np.linalg.norm(first - second, axis=1).max() < 0.01
    assert not (tmp_path / "robot" / "map.pliant").exists()


def test_a_map_localises_an_image_in_python(office: Path) -> None:
    known = library.load_map(office)
    frames = list(open_source(TINY))
    found = known.localise(decode(frames[10]))
    assert found is not None
    position = read_tum(office / "trajectory.txt").positions[10]
    assert np.linalg.norm(found.T_world_camera[:3, 3] - position) < 0.01
    assert known.localise(np.zeros_like(decode(frames[10]))) is None
    assert known.localise(decode(frames[10]), known.calibration) is not None
    assert len(known.points) == len(known.colours) == len(known.segments) > 100


def test_a_result_depends_on_no_earlier_request(office: Path) -> None:
    known = library.load_map(office)
    images = [decode(frame) for frame in list(open_source(TINY))[::8]]
    answers = [known.localise(image) for image in images]
    for image, first in reversed(list(zip(images, answers, strict=True))):
        again = known.localise(image)
        assert first is not None
        assert again is not None
        assert np.array_equal(first.T_world_camera, again.T_world_camera)
        assert first.inliers == again.inliers


def test_images_of_another_camera_are_found_in_the_map(office: Path) -> None:
    """Larger ones, and their middle alone: another focal length, size and principal point."""
    known, truth = library.load_map(office), read_tum(office / "trajectory.txt")
    larger = open_source(f"{TINY}?width=400")
    calibration = larger.calibration
    cut = replace(
        calibration, width=330, height=250,
        cx=calibration.cx - 40.0, cy=calibration.cy - 20.0,
    )  # fmt: skip
    for frame in list(larger)[::6]:
        whole = decode(frame)
        for image, camera in ((whole, calibration), (whole[20:270, 40:370], cut)):
            found = known.localise(image, camera)
            assert found is not None
            between = inverse(truth.T_world_camera[frame.index]) @ found.T_world_camera
            assert np.linalg.norm(between[:3, 3]) < 0.01
            assert np.degrees(np.linalg.norm(so3_log(between[:3, :3]))) < 0.5


def test_two_maps_become_one_in_which_images_are_found(office: Path, tmp_path: Path) -> None:
    tuesday, one = tmp_path / "tuesday", tmp_path / "one.pliant"
    assert (
        in_this_process("run", TINY, "--start", "0.4", *NO_MESH, "--output", tuesday).returncode
        == 0
    )
    done = in_this_process("map", "merge", office, tuesday, "--output", one)
    assert done.returncode == 0, done.stderr
    assert "is now part of segment 0" in done.stdout
    told = in_this_process("map", "info", one).stdout
    assert "sessions: 2" in told
    assert "segment 0:" in told
    assert "segment 1:" not in told
    known, frames = library.load_map(one), list(open_source(TINY))
    assert all(known.localise(decode(frame)) is not None for frame in frames[::6])
    whole = one.read_bytes()
    damaged = tmp_path / "damaged.pliant"
    damaged.write_bytes(whole[: len(whole) // 2])
    for arguments, why in (
        ((office, tuesday, "--output", one), "--force"),
        ((office, one, "--output", one, "--force"), "is read from there"),
        ((office, damaged, "--output", tmp_path / "new.pliant"), "damaged"),
    ):
        assert_one_line(in_this_process("map", "merge", *arguments), why)
    assert one.read_bytes() == whole
    assert not (tmp_path / "new.pliant").exists()


def test_what_is_no_map_of_use_is_said_before_anything_is_touched(
    office: Path, tmp_path: Path
) -> None:
    target = tmp_path / "there"
    for arguments, why in (
        (("--map", tmp_path / "nowhere"), "no map: pass"),
        (("--map", office / "recording.mcap"), "no map"),
        (("--map", office, "--output", office, "--force"), "is read from there"),
    ):
        output = () if "--output" in arguments else ("--output", target)
        done = in_this_process("run", TINY, *arguments, *output)
        assert_one_line(done, why)
        assert not target.exists()
    deformable = ("--profile", "deformable")
    for arguments in (("--localise",), ("--map", office, *deformable), ("--light", *deformable)):
        done = in_this_process("run", TINY, *arguments, "--output", target)
        assert done.returncode == 2
    assert (office / "map.pliant").is_file()
