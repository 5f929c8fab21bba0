"""Two kept maps that show the same places become one."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mapping_scene import CAMERA, INTERVAL_NS
from pictured_scene import MERGING, Film, along, dark, film, messages, textures, wall

from pliant.algorithms.geometry import align_umeyama, inverse, transform
from pliant.algorithms.map_delta import TRACKING
from pliant.algorithms.slam.atlas.merging import Merged, merge
from pliant.algorithms.slam.calibration.self_calibration import SelfCalibration
from pliant.algorithms.slam.frame import Frame
from pliant.algorithms.slam.localiser import Localiser
from pliant.algorithms.slam.map.kept_keyframe import KeptKeyframe
from pliant.algorithms.slam.mapper import Mapper
from pliant.algorithms.slam.store.kept_map import corrected_as
from pliant.algorithms.tracks import FrameExtrema
from pliant.errors import PliantError
from pliant.messages import codec
from pliant.messages.types import MapKeyframe
from pliant.recording.map_file import MAP_NAME, MapFile, MapHeader, write_map
from pliant.results import merged_map
from pliant.results.merged_map import merge_maps

WALL, SQUARES = wall(), textures(1150)
FIRST, SECOND = along(0, 6), along(9, 3)
Two = tuple[list[MapKeyframe], list[MapKeyframe]]
NIGHT = [dark(FrameExtrema.empty())] * 40


def mapped(shots: Film) -> list[MapKeyframe]:
    mapper = Mapper(CAMERA, MERGING, 0)
    for k, (tracks, grey) in enumerate(shots):
        mapper.process(Frame(k, k * INTERVAL_NS, tracks, grey))
        mapper.publish_keyframes()
    mapper.finish()
    return messages(mapper)


@pytest.fixture(scope="module")
def two() -> Two:
    """One end of a wall, and the other one as far as the middle, with something else after that."""
    other = wall(seed=3)
    elsewhere = film(other, textures(1150)[::-1], along(0, 2), 1)
    first = mapped(film(WALL, SQUARES, FIRST, 0))
    return first, mapped(film(WALL, SQUARES, SECOND, 0) + NIGHT + elsewhere)


@pytest.fixture(scope="module")
def one(two: Two) -> Merged:
    made = merge(*two, MERGING)
    assert made is not None
    return made


def errors_of(kept: list[KeptKeyframe]) -> np.ndarray:
    """Of all keyframes on the wall, after one alignment."""
    some = [k for k in kept if k.segment == 0]
    mine = np.array([k.T_world_camera[:3, 3] for k in some])
    true = np.array([(FIRST, SECOND)[k.session][k.source_frame][:3, 3] for k in some])
    scale, R, t = align_umeyama(mine, true, with_scale=True)
    return np.linalg.norm(scale * mine @ R.T + t - true, axis=1)


def test_what_shows_the_same_places_is_one_world(two: Two, one: Merged) -> None:
    first, second = two
    assert {k.segment for k in second} == {0, 1}
    assert one.joined == [(0, 0)]
    assert one.apart == [(1, 2)]
    assert one.proofs >= 2
    assert [k.id for k in one.keyframes] == list(range(len(first) + len(second)))
    assert {k.session for k in one.keyframes} == {0, 1}
    np.testing.assert_allclose(one.keyframes[0].T_world_camera, first[0].T_world_camera, atol=1e-12)
    assert errors_of(one.keyframes).max() < 5e-3


def test_common_points_of_two_maps_are_merged(two: Two, one: Merged) -> None:
    ids = [set(k.point_ids.tolist()) for k in one.keyframes]
    assert len(set.union(*ids)) == sum(map(len, ids))
    seen = [
        {point for k in one.keyframes if (k.session, k.segment) == each for point in k.seen_ids}
        for each in ((0, 0), (1, 0))
    ]
    assert len(seen[0] & seen[1]) > 100
    assert set.union(*seen) <= set.union(*ids)


def test_what_met_nothing_stays_as_it_was(two: Two, one: Merged) -> None:
    before = [k for k in two[1] if k.segment == 1]
    after = [k for k in one.keyframes if k.segment == 2]
    for old, new in zip(before, after, strict=True):
        np.testing.assert_array_equal(old.T_world_camera, new.T_world_camera)
        np.testing.assert_array_equal(old.points_world, new.points_world)
        np.testing.assert_array_equal(old.seen_px, new.seen_px)
        assert len({*(new.point_ids - old.point_ids).tolist()}) <= 1


def test_the_same_maps_give_the_same_bytes(two: Two, one: Merged) -> None:
    again = merge(*two, MERGING)
    assert again is not None
    for each, other in zip(one.keyframes, again.keyframes, strict=True):
        for name, value in vars(each).items():
            np.testing.assert_array_equal(value, getattr(other, name))


def test_frames_of_either_find_themselves_in_it(one: Merged) -> None:
    for poses in (FIRST[:3], SECOND[:3]):
        localiser = Localiser(CAMERA, MERGING, 0, known=one.keyframes)
        for k, (tracks, grey) in enumerate(film(WALL, SQUARES, poses, 5)):
            delta = localiser.process(Frame(k, k * INTERVAL_NS, tracks, grey))
            assert (delta.state, delta.segment) == (TRACKING, 0)


def test_another_wall_is_not_merged(two: Two) -> None:
    first, second = two
    assert merge(first, [k for k in second if k.segment == 1], MERGING) is None


def test_another_correction_of_the_camera_moves_nothing_in_the_image(two: Two) -> None:
    correction = np.array([0.02, -0.01, 0.0, 0.0, 0.003, 0.0, -0.02])
    other = SelfCalibration(CAMERA, correction, np.eye(7))
    before = two[0][-1]
    own = SelfCalibration(CAMERA, before.correction, np.diag(before.sigmas**2))
    moved = corrected_as(before, other)
    assert np.abs(moved.seen_px - before.seen_px).max() > 0.5
    back = corrected_as(moved, own)
    np.testing.assert_allclose(back.seen_px, before.seen_px, atol=1e-3)
    np.testing.assert_allclose(back.corners_px, before.corners_px, atol=1e-3)
    np.testing.assert_array_equal(back.correction, before.correction)


def test_a_map_of_another_focal_length_is_merged_as_this_one_would_have_it(two: Two) -> None:
    """The rays of one image differ by a twentieth, 20 px at its border."""
    first, second = two
    own = second[0].correction
    other = SelfCalibration(CAMERA, own + np.array([0.05, 0, 0, 0, 0, 0, 0]), np.eye(7))
    before = SelfCalibration(CAMERA, own, np.eye(7)).view.camera
    made: list[MapKeyframe] = []
    for each in second:
        here = transform(inverse(each.T_world_camera), each.points_world)
        here[:, :2] *= before.fx / other.view.camera.fx
        there = transform(each.T_world_camera, here)
        made.append(replace(corrected_as(each, other), points_world=there))
    merged = merge(first, made, MERGING)
    assert merged is not None
    assert merged.joined == [(0, 0)]


def test_another_camera_is_merged_by_its_own_rays(two: Two) -> None:
    first, second = two
    f, shift = 1.3, np.array([20.0, -10.0])
    given = np.array(
        [900.0, 620.0, *(f * second[0].given[2:4]), *(f * second[0].given[4:] + shift)]
    )

    def seen(points_px: np.ndarray) -> np.ndarray:
        return (f * points_px + shift).astype(np.float32)

    other = [
        replace(
            k, given=given, seen_px=seen(k.seen_px), rolled_px=np.float32(f) * k.rolled_px,
            corners_px=seen(k.corners_px),
        )
        for k in second
    ]  # fmt: skip
    made = merge(first, other, MERGING)
    assert made is not None
    assert made.joined == [(0, 0)]
    assert errors_of(made.keyframes).max() < 1e-2
    assert {tuple(k.given) for k in made.keyframes if k.segment == 0} == {tuple(first[0].given)}


@pytest.fixture
def files(two: Two, tmp_path: Path) -> tuple[Path, Path]:
    header = MapHeader(source="a wall")
    for name, kept in zip(("monday", "tuesday"), two, strict=True):
        (tmp_path / name).mkdir()
        write_map(tmp_path / name / MAP_NAME, header, kept)
    return tmp_path / "monday", tmp_path / "tuesday"


def test_files_become_one_file(files: tuple[Path, Path], tmp_path: Path) -> None:
    output = tmp_path / "new" / "office.pliant"
    lines = list(merge_maps(*files, output, force=False))
    assert "segment 0 of" in lines[1]
    assert "shows no place" in lines[2]
    assert len(list(MapFile(output).keyframes())) > 10
    before = output.read_bytes()
    list(merge_maps(*files, output, force=True))
    assert output.read_bytes() == before
    assert [each.name for each in output.parent.iterdir()] == ["office.pliant"]


def test_nothing_is_written_where_it_cannot_be(
    files: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = files
    link = tmp_path / "link.pliant"
    link.symlink_to(first / MAP_NAME)
    there = tmp_path / "there.pliant"
    there.write_text("mine")
    whole = (second / MAP_NAME).read_bytes()
    damaged = tmp_path / "damaged.pliant"
    damaged.write_bytes(whole[: len(whole) // 2])
    blind = tmp_path / "elsewhere.pliant"
    kept = list(MapFile(second).keyframes())
    write_map(blind, MapHeader(), [k for k in kept if k.segment == 1])
    new = tmp_path / "new.pliant"
    everything = {path: path.is_file() and path.read_bytes() for path in tmp_path.rglob("*")}
    for a, b, output, force, why in (
        (first, second, first / MAP_NAME, True, "is read from there"),
        (first, second, link, True, "is read from there"),
        (first, second, first, True, "is read from there"),
        (first, second, there, False, "--force"),
        (first, second, tmp_path, True, "is read from there"),
        (first, link, new, False, "is the same map as the first"),
        (first, damaged, new, False, "damaged"),
        (first, tmp_path / "nowhere", new, False, "no map: pass"),
        (first, blind, new, False, "shows a place of"),
    ):
        with pytest.raises(PliantError) as refused:
            list(merge_maps(a, b, output, force=force))
        assert why in str(refused.value)
        assert "\n" not in str(refused.value)

    def interrupted(*_: object) -> bytes:
        raise KeyboardInterrupt

    def merged(*_: object) -> Merged:
        return Merged(joined=[], apart=[], proofs=0, keyframes=[*kept])

    monkeypatch.setattr(merged_map, "merge", merged)
    monkeypatch.setattr(codec, "encode", interrupted)
    with pytest.raises(KeyboardInterrupt):
        list(merge_maps(first, second, new, force=False))
    assert everything == {p: p.is_file() and p.read_bytes() for p in tmp_path.rglob("*")}
