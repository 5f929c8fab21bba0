"""A map that is kept: another session goes on in it, or finds itself in it."""

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mapped_scene import Published, trajectory_error
from mapping_scene import CAMERA, INTERVAL_NS, Scene, looking, sideways
from pictured_scene import Film, dark, film, messages, run, textures

from pliant.algorithms.arrays import F64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse, transform
from pliant.algorithms.map_delta import TRACKING, WAITING
from pliant.algorithms.slam.calibration.self_calibration import SelfCalibration
from pliant.algorithms.slam.frame import Frame
from pliant.algorithms.slam.localiser import Localiser
from pliant.algorithms.slam.map.kept_keyframe import MAP_VERSION, KeptKeyframe
from pliant.algorithms.slam.map.landmarks import MAPPED, Landmarks
from pliant.algorithms.slam.mapper import Mapper
from pliant.algorithms.slam.parameters import MappingParameters
from pliant.algorithms.slam.store.kept_map import check, take_in
from pliant.algorithms.tracks import FrameExtrema, FrameTracks
from pliant.errors import MapError
from pliant.map_history import MapHistory
from pliant.messages import codec
from pliant.messages.types import MapKeyframe
from pliant.recording import map_file
from pliant.recording.map_file import MAP_NAME, MapFile, MapHeader, describe, write_map
from pliant.state import load_state, save_state

PARAMETERS = MappingParameters()
THERE = sideways(30, step=0.04)


@pytest.fixture(scope="module")
def place() -> tuple[Scene, list[np.ndarray]]:
    scene = Scene.box(500, noise_px=0.1)
    return scene, textures(len(scene.points))


@pytest.fixture(scope="module")
def kept(place: tuple[Scene, list[np.ndarray]]) -> list[MapKeyframe]:
    _, mapper = run(film(*place, THERE))
    mapper.finish()
    return messages(mapper)


def again(place: tuple[Scene, list[np.ndarray]]) -> tuple[list[np.ndarray], Film]:
    """The same place on another day, from a little aside."""
    poses = [T @ looking((0.05, 0.1, 0.1), (0.02, -0.05, 0.1)) for T in THERE[5:25]]
    return poses, film(*place, poses)


def test_a_map_is_the_same_bytes_after_it_was_loaded(kept: list[MapKeyframe]) -> None:
    mapper = Mapper(CAMERA, PARAMETERS, 0, known=kept)
    mapper.finish()
    assert [codec.encode(m) for m in messages(mapper)] == [codec.encode(m) for m in kept]


def test_a_file_holds_the_map(kept: list[MapKeyframe], tmp_path: Path) -> None:
    header = MapHeader(source="a room", calibration="model: pinhole\n")
    assert write_map(tmp_path / MAP_NAME, header, kept)
    file = MapFile(tmp_path)
    assert file.header == header
    assert [codec.encode(m) for m in file.keyframes()] == [codec.encode(m) for m in kept]
    assert write_map(tmp_path / "other.pliant", header, file.keyframes())
    assert (tmp_path / "other.pliant").read_bytes() == (tmp_path / MAP_NAME).read_bytes()
    assert f"{len(kept)} keyframes" in "\n".join(describe(tmp_path))


def test_another_session_continues_in_the_map(
    place: tuple[Scene, list[np.ndarray]], kept: list[MapKeyframe]
) -> None:
    poses, shots = again(place)
    mapper = Mapper(CAMERA, PARAMETERS, 0, known=kept)
    history, published = MapHistory(), Published()
    for each in kept:
        history.know(each)
    known_points = set(history.points().ids.tolist())
    told: list[int] = []
    places: list[list[int]] = []
    for k, (tracks, grey) in enumerate(shots):
        delta = mapper.process(Frame(k, k * INTERVAL_NS, tracks, grey))
        places += delta.same_places.tolist()
        history.apply(delta, frame=k, stamp_ns=k)
        published.apply(delta)
        told += mapper.publish_keyframes().keyframe_ids.tolist()
    history.apply(mapper.finish(), frame=0, stamp_ns=0, final=True)
    assert published.states == [TRACKING] * len(shots)
    assert places[0][0] <= kept[-1].id < places[0][1]  # where it was recognised
    assert sorted(history.final()) == list(range(len(shots)))
    assert {segment for segment, _ in history.final().values()} == {0}
    # The world is that of the first session: its first keyframe.
    scale = np.linalg.norm(kept[-1].T_world_camera[:3, 3]) / np.linalg.norm(
        (inverse(THERE[kept[0].source_frame]) @ THERE[kept[-1].source_frame])[:3, 3]
    )
    for k, (_, pose) in history.final().items():
        true = (inverse(THERE[kept[0].source_frame]) @ poses[k])[:3, 3]
        assert np.linalg.norm(pose[:3] - scale * true) < 0.01 * scale
    assert all(number > kept[-1].id for number in told)
    # Both sessions' keyframes and points are there, under numbers of their own.
    after = messages(mapper)
    ids = [each.id for each in after]
    assert ids == sorted(set(ids))
    assert {each.id for each in kept} <= set(ids)
    assert {(e.session, e.source_frame) for e in after if e.id <= kept[-1].id} == {
        (0, e.source_frame) for e in kept
    }
    assert {each.session for each in after if each.id > kept[-1].id} == {1}
    points = np.concatenate([each.point_ids for each in after])
    assert len(set(points.tolist())) == len(points)
    assert len(known_points & set(points.tolist())) > 0.9 * len(known_points)
    assert set(history.points().ids.tolist()) == set(points.tolist())
    assert min(frame for frame in history.keyframe_poses()) >= 0


def test_the_same_frames_give_the_same_map_from_a_checkpoint(
    place: tuple[Scene, list[np.ndarray]], kept: list[MapKeyframe]
) -> None:
    _, shots = again(place)
    _, whole = run(shots, Mapper(CAMERA, PARAMETERS, 0, known=kept))
    _, first = run(shots[:8], Mapper(CAMERA, PARAMETERS, 0, known=kept))
    _, rest = run(shots[8:], load_state(save_state(first)), 8)
    for mapper in (whole, rest):
        mapper.finish()
    assert [codec.encode(m) for m in messages(rest)] == [codec.encode(m) for m in messages(whole)]


def test_what_is_elsewhere_becomes_a_segment_of_its_own(
    place: tuple[Scene, list[np.ndarray]], kept: list[MapKeyframe]
) -> None:
    elsewhere = Scene.box(500, seed=9, noise_px=0.1)
    published, mapper = run(
        film(elsewhere, place[1][::-1], THERE), Mapper(CAMERA, PARAMETERS, 0, known=kept)
    )
    mapper.finish()
    assert {segment for _, _, segment in published.poses.values()} == {1}
    after = messages(mapper)
    known = [each for each in after if each.segment == 0]
    assert [codec.encode(m) for m in known] == [codec.encode(m) for m in kept]
    assert min(each.id for each in after if each.segment == 1) > kept[-1].id


def test_frames_are_localised_and_nothing_is_mapped(
    place: tuple[Scene, list[np.ndarray]], kept: list[MapKeyframe]
) -> None:
    poses, shots = again(place)
    shots = [dark(FrameExtrema.empty()), *shots]
    published, localiser = Published(), Localiser(CAMERA, PARAMETERS, 0, known=kept)
    for k, (tracks, grey) in enumerate(shots):
        if k == 10:  # it may be started again
            localiser = load_state(save_state(localiser))
        delta = localiser.process(Frame(k, k * INTERVAL_NS, tracks, grey))
        assert len(delta.same_places) == (k == 1)
        published.apply(delta)
        assert not len(localiser.publish_keyframes().keyframe_ids)
    assert published.states == [WAITING] + [TRACKING] * len(poses)
    error, _ = trajectory_error(published, [np.eye(4), *poses])
    assert error < 3e-3
    assert list(localiser.kept()) == []


def test_few_tracks_that_lead_on_need_no_look_at_the_whole_map(
    place: tuple[Scene, list[np.ndarray]],
    kept: list[MapKeyframe],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """However many points are found again without tracks."""
    asked: list[int] = []
    recognise = Localiser.recognise

    def counted(self: Localiser, *args: Any) -> Any:
        asked.append(1)
        return recognise(self, *args)

    monkeypatch.setattr(Localiser, "recognise", counted)
    poses, shots = again(place)
    localiser = Localiser(CAMERA, PARAMETERS, 0, known=kept)
    for k, (tracks, grey) in enumerate(shots):
        few = tracks.ids % 8 == 0
        all_of = {field.name: getattr(tracks, field.name) for field in fields(FrameTracks)}
        some = {name: each[few] for name, each in all_of.items() if len(each) == len(few)}
        seen = replace(tracks, **some)
        delta = localiser.process(Frame(k, k * INTERVAL_NS, seen, grey))
        assert delta.state == TRACKING
        assert delta.inliers > 5 * len(seen.ids)
    assert len(shots) == len(poses)
    assert asked == [1]


def test_frames_of_a_rolling_shutter_are_localised_as_if_taken_at_once(
    place: tuple[Scene, list[np.ndarray]], kept: list[MapKeyframe]
) -> None:
    readout = 0.6

    def at(t: float) -> F64:
        """Still at first, then ever faster."""
        moved = max(t - 1.0, 0.0) ** 2 / 20.0
        turn = 0.05 * np.sin(0.4 * moved), 0.06 * np.sin(0.3 * moved), 0.0
        return looking((0.3 + 0.03 * moved, 0.05 * np.sin(0.3 * moved), 0.0), turn)

    poses = [at(k) for k in range(30)]
    (_, grey), *_ = film(*place, poses[:1])
    frames = list(place[0].frames(poses, later=at, readout=readout))
    errors: list[float] = []
    for known in (0.0, readout):
        published = Published()
        correction = np.array([0.0, 0.0, 0.0, known, 0.0, 0.0, 0.0])
        of_camera = [replace(k, correction=correction, sigmas=np.full(7, 1e-3)) for k in kept]
        localiser = Localiser(CAMERA, PARAMETERS, 0, known=of_camera)
        assert localiser.calibration.readout == known
        for k, tracks in enumerate(frames):
            image = grey if k == 0 else None
            published.apply(localiser.process(Frame(k, k * INTERVAL_NS, tracks, image)))
        assert published.states == [TRACKING] * len(poses)
        errors.append(trajectory_error(published, poses)[0])
    assert errors[1] < 0.3 * errors[0]
    assert errors[1] < 6e-3


def test_another_camera_sees_the_map_with_its_own_calibration(kept: list[MapKeyframe]) -> None:
    other = PinholeCamera(width=800, height=600, fx=700.0, fy=690.0, cx=390.0, cy=310.0)
    points = Landmarks()
    known = SelfCalibration.of(other, PARAMETERS.calibration)
    (segment,) = take_in(kept, points, known)
    for keyframe in segment.keyframes:
        assert (points.state[keyframe.rows] == MAPPED).all()
        seen = transform(inverse(keyframe.T_world_camera), points.xyz[keyframe.rows])
        errors = np.linalg.norm(other.project(seen) - keyframe.points_px, axis=1)
        assert np.median(errors) < 1.0
    assert not np.array_equal(points.patches[: len(kept[0].point_ids)], kept[0].point_patches)


def test_a_map_from_before_the_aspect_ratio_is_read_with_a_correct_one(
    tmp_path: Path, kept: list[MapKeyframe]
) -> None:
    old = [replace(each) for each in kept]
    for each in old:
        for name in ("correction", "sigmas"):
            object.__setattr__(each, name, getattr(each, name)[:6])
    write_map(tmp_path / MAP_NAME, MapHeader(version=2), old)
    for was, now in zip(kept, MapFile(tmp_path).keyframes(), strict=True):
        np.testing.assert_array_equal(now.correction, [*was.correction[:6], 0.0])
        np.testing.assert_array_equal(now.sigmas, [*was.sigmas[:6], 0.0])


def test_a_map_that_cannot_be_is_refused_in_one_line(
    kept: list[MapKeyframe], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / MAP_NAME

    def why(source: Path = path) -> str:
        with pytest.raises(MapError) as refused:
            list(MapFile(source).keyframes())
        assert "\n" not in str(refused.value)
        return str(refused.value)

    assert "no map: pass" in why(tmp_path)
    path.write_bytes(b"no map at all")
    assert "no map" in why()
    assert not write_map(path, MapHeader(), [])
    write_map(path, MapHeader(version=MAP_VERSION + 1, release="9.9"), kept)
    assert f"version {MAP_VERSION + 1} (pliant 9.9)" in why()
    write_map(path, MapHeader(), kept)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    assert "damaged" in why()
    spoiled = bytearray(whole)
    spoiled[len(whole) // 2] ^= 0xFF
    path.write_bytes(bytes(spoiled))
    assert "damaged" in why()
    blind = [
        replace(each, corners_px=each.corners_px[:0], descriptors=each.descriptors[:0])
        for each in kept
    ]
    write_map(path, MapHeader(), blind)
    assert "without a place" in why()
    write_map(path, MapHeader(), kept[::-1])
    assert "out of order" in why()
    with map_file.RecordingWriter(path, {"map": {"version": "1"}}):
        pass
    assert "empty" in why()


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("T_world_camera", 2.0 * np.eye(4)),
        ("given", np.zeros(6)),
        ("given", np.array([1e9, 480.0, 500.0, 500.0, 320.0, 240.0])),
        ("id", 1 << 62),
        ("segment", 1 << 62),
        ("session", -1),
        ("source_frame", 1 << 62),
        ("point_ids", None),
        ("points_world", None),
        ("point_patches", None),
    ],
)
def test_values_that_cannot_be_are_refused(
    kept: list[MapKeyframe], field: str, value: np.ndarray | int | None
) -> None:
    good: KeptKeyframe = kept[0]
    assert len(good.point_ids) > 2
    wrong = {
        "point_ids": good.point_ids[::-1],
        "points_world": np.full_like(good.points_world, np.nan),
        "point_patches": good.point_patches[:, :4, :4],
    }
    check(good)
    with pytest.raises(ValueError):
        check(replace(good, **{field: wrong[field] if value is None else value}))
