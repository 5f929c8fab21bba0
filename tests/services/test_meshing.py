"""The meshing service on the in-memory bus: what it sends, that it is the same again, bad input."""

from collections.abc import Callable, Iterator
from dataclasses import replace

import cv2
import numpy as np
import pytest

from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse, matrix_to_pose, move_by_similarity, transform
from pliant.algorithms.image.masks import packed
from pliant.algorithms.meshing.mesh_blocks import BlockMesh, TriangleMesh
from pliant.algorithms.meshing.rendering import DrawnTriangles
from pliant.bus.replay_bus import ReplayBus
from pliant.config import load_config
from pliant.fusion.keyframe_spool import KeyframeSpool
from pliant.messages import codec, topics
from pliant.messages.mesh_pieces import joined, split
from pliant.messages.topics import Topic
from pliant.messages.types import (
    CameraStream,
    Header,
    Keyframe,
    MapUpdate,
    MeshPiece,
    MeshUpdate,
)
from pliant_services.nodes import meshing
from pliant_services.runtime.monitor import SilentMonitor

CAMERA = PinholeCamera(width=160, height=120, fx=140.0, fy=140.0, cx=79.5, cy=59.5)
POINTS = 1500
FRAMES = 6
WINDOW = 2
VOXEL = 0.2
"""Of the coarse mesh: the wall is at 4."""


def stream(mode: str = "lossless") -> CameraStream:
    return CameraStream(
        frame=0, stamp_ns=0, frame_id="camera", source="wall", mode=mode, frames=FRAMES,
        calibration="", width=160, height=120, fx=140.0, fy=140.0, cx=79.5, cy=59.5,
    )  # fmt: skip


def world() -> np.ndarray:
    """Points on a wall at 4 and on a box before it."""
    generator = np.random.default_rng(0)
    x, y = generator.uniform((-3.0, -2.0), (3.0, 2.0), (POINTS, 2)).T
    return np.stack([x, y, np.where(np.abs(x) < 0.7, 3.0, 4.0)], axis=1)


def pose(frame: int) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = 0.15 * frame
    return T


def seen(frame: int) -> tuple[np.ndarray, np.ndarray]:
    local = world() - pose(frame)[:3, 3]
    pixels = CAMERA.project(local)
    inside = np.all((pixels > 0) & (pixels < (159, 119)), axis=1)
    return np.flatnonzero(inside), pixels[inside].astype(np.float32)


def map_update(frame: int, *, last: bool = False) -> MapUpdate:
    none = np.zeros(0, np.int64)
    first = frame == 0
    ids = np.arange(POINTS * first, dtype=np.int64)
    key = np.array([] if last else [frame], np.int64)
    return MapUpdate(
        frame=frame, stamp_ns=frame, frame_id="world", state=1, reason="", segment=0, inliers=0,
        pose_frames=none, pose_segments=none.astype(np.int32), pose_keyframes=none,
        poses_keyframe_camera=np.zeros((0, 7)), pose_inliers=none.astype(np.int32),
        keyframe_ids=key, keyframe_frames=key, keyframe_segments=np.zeros(len(key), np.int32),
        keyframe_poses=matrix_to_pose(pose(frame)[None])[: len(key)],
        point_ids=ids, point_segments=np.zeros(len(ids), np.int32),
        points_world=world()[: len(ids)], point_colours=np.zeros((len(ids), 3), np.uint8),
        point_keyframes=np.full(len(ids), 5, np.int32),
        point_parallax_rad=np.full(len(ids), 0.1, np.float32),
        point_sigmas=np.full(len(ids), 0.01, np.float32), removed_point_ids=none,
        point_hosts=np.zeros(len(ids), np.int64),
    )  # fmt: skip


def keyframe(frame: int, new: int, settled: list[int]) -> Keyframe:
    told = [*settled, *([new] if new >= 0 else [])]
    observed = [seen(number) for number in told]
    image = np.full((120, 160), 40 * max(new, 0), np.uint8)
    return Keyframe(
        frame=frame, stamp_ns=frame, frame_id="camera", new=new,
        keyframe_ids=np.array(told, np.int64),
        settled=np.array([number in settled for number in told], np.bool_),
        counts=np.array([len(ids) for ids, _ in observed], np.int32),
        point_ids=np.concatenate([np.zeros(0, np.int64), *(ids for ids, _ in observed)]),
        points_px=np.concatenate([np.zeros((0, 2), np.float32), *(px for _, px in observed)]),
        jpeg=cv2.imencode(".jpg", image)[1].tobytes() if new >= 0 else b"",
    )  # fmt: skip


Inputs = dict[Topic, list[Header]]


def inputs(mode: str = "lossless") -> Inputs:
    leaving = [[frame - WINDOW] if frame >= WINDOW else [] for frame in range(FRAMES)]
    rest = list(range(FRAMES - WINDOW, FRAMES))
    return {
        topics.STREAM: [stream(mode)],
        topics.MAP_UPDATE: [map_update(frame) for frame in range(FRAMES)],
        topics.KEYFRAME: [keyframe(frame, frame, leaving[frame]) for frame in range(FRAMES)],
        topics.MAP_FINAL: [map_update(FRAMES - 1, last=True)],
        topics.KEYFRAME_FINAL: [keyframe(FRAMES - 1, -1, rest)],
    }


class Notes(SilentMonitor):
    """Keeps what the service says of itself."""

    def __init__(self) -> None:
        self.notes: list[str] = []
        self.counters: dict[str, float] = {}
        self.again: list[float] = []

    def report(self, header: Header, *, note: str = "", **counters: float) -> None:
        self.notes += [note] if note else []
        self.counters = counters
        self.again.append(counters["again"])


def run(given: Inputs, monitor: Notes | None = None) -> dict[Topic, list[Header]]:
    bus = ReplayBus(given)
    meshing.run(bus, load_config(), monitor or Notes())
    return bus.outputs


def final(outputs: dict[Topic, list[Header]], level: str) -> MeshPiece:
    (piece,) = [
        m for m in outputs[topics.MESH_FINAL] if isinstance(m, MeshPiece) and m.level == level
    ]
    return piece


@pytest.fixture(scope="module")
def outputs() -> dict[Topic, list[Header]]:
    return run(inputs())


def test_the_final_mesh_lies_on_the_wall_and_the_box(outputs: dict[Topic, list[Header]]) -> None:
    for level, share in (("fine", 0.8), ("coarse", 0.7)):
        mesh = final(outputs, level)
        assert len(mesh.triangles) > 50
        z = mesh.positions[:, 2]
        distance = np.minimum(np.abs(z - 3.0), np.abs(z - 4.0))
        assert np.mean(distance < 0.02) > share
        on_wall = distance < 0.02
        assert np.median(mesh.normals[on_wall, 2]) < -0.99  # towards the camera
    assert final(outputs, "fine").voxel_size < final(outputs, "coarse").voxel_size


@pytest.mark.parametrize("segment", [0, 1])
def test_only_the_segment_that_the_last_adjustment_had_is_seen_by_the_corrected_camera(
    segment: int, outputs: dict[Topic, list[Header]]
) -> None:
    """The keyframes are of segment 0."""
    given = inputs()
    last = map_update(FRAMES - 1, last=True)
    given[topics.MAP_FINAL] = [
        replace(last, segment=segment, calibration_correction=(0.1, 0.0, 0.0, 0.0))
    ]
    plain, found = final(outputs, "fine"), final(run(given), "fine")
    assert (codec.encode(found) == codec.encode(plain)) == (segment == 1)


def test_the_same_bytes_again(outputs: dict[Topic, list[Header]]) -> None:
    again = run(inputs())
    for topic in (topics.MESH_BLOCKS, topics.MESH_FINAL):
        before = [codec.encode(message) for message in outputs[topic]]
        assert [codec.encode(message) for message in again[topic]] == before


def test_blocks_that_changed_make_the_live_mesh_and_the_others_bring_late_viewers_up_to_date(
    outputs: dict[Topic, list[Header]],
) -> None:
    viewer, late = BlockMesh(), BlockMesh()
    updates = [m for m in outputs[topics.MESH_BLOCKS] if isinstance(m, MeshUpdate)]
    assert [m.again for m in updates] == [False, True] * FRAMES
    for update in updates:
        if not update.again:
            viewer.apply(update)
        if update.frame >= 2:  # it came after two frames
            late.apply(update)
    whole = viewer.mesh()
    assert len(whole.triangles) > 50
    np.testing.assert_array_equal(late.mesh().positions, whole.positions)
    # What had left the window is as in the final mesh, the rest as good.
    assert abs(len(whole.triangles) / len(final(outputs, "coarse").triangles) - 1.0) < 0.1


class LateBus(ReplayBus):
    """There is always something waiting, until the last frames."""

    def is_waiting(self, topic: Topic) -> bool:
        self.asked = getattr(self, "asked", 0) + 1
        return self.asked < FRAMES


def test_live_passes_over_previews_when_it_is_late_and_the_final_mesh_is_the_same(
    outputs: dict[Topic, list[Header]],
) -> None:
    monitor = Notes()
    bus = LateBus(inputs("live"))
    meshing.run(bus, load_config(), monitor)
    assert monitor.counters["passed_over"] == FRAMES - 1
    assert len(bus.outputs[topics.MESH_BLOCKS]) == 2
    for message, other in zip(
        bus.outputs[topics.MESH_FINAL], outputs[topics.MESH_FINAL], strict=True
    ):
        assert codec.encode(message) == codec.encode(other)


def with_keyframes(change: Callable[[Keyframe], Keyframe]) -> Inputs:
    given = inputs()
    told = given[topics.KEYFRAME]
    assert isinstance(told[3], Keyframe)
    told[3] = change(told[3])
    return given


def few(message: Keyframe) -> Keyframe:
    counts = np.array([*message.counts[:-1], 2], np.int32)
    total = int(counts.sum())
    return replace(
        message, counts=counts, point_ids=message.point_ids[:total],
        points_px=message.points_px[:total],
    )  # fmt: skip


def jumped(given: Inputs) -> Inputs:
    update = given[topics.MAP_UPDATE][3]
    assert isinstance(update, MapUpdate)
    far = update.keyframe_poses.copy()
    far[:, 0] += 100.0
    given[topics.MAP_UPDATE][3] = replace(update, keyframe_poses=far)
    return given


def broken_points(given: Inputs) -> Inputs:
    update = given[topics.MAP_UPDATE][0]
    assert isinstance(update, MapUpdate)
    points = update.points_world.copy()
    points[::3] = np.nan
    points[1::3, 2] *= -1.0
    given[topics.MAP_UPDATE][0] = replace(update, points_world=points)
    return given


def bad_inputs() -> Iterator[tuple[str, Inputs, str]]:
    yield "few", with_keyframes(few), "keyframe 3 is passed over: 2 points"
    yield "jump", jumped(inputs()), "keyframe 3 is passed over: 0 points"
    yield "image", with_keyframes(lambda k: replace(k, jpeg=b"")), "no image"
    yield "lies", with_keyframes(lambda k: replace(k, jpeg=b"no jpeg")), "no image"
    yield "points", broken_points(inputs()), ""


@pytest.mark.parametrize(("name", "given", "words"), [(n, g, w) for n, g, w in bad_inputs()])
def test_bad_input_is_reported_and_passed_over(name: str, given: Inputs, words: str) -> None:
    monitor = Notes()
    made = run(given, monitor)
    assert any(words in note for note in monitor.notes) or not words
    mesh = final(made, "fine")
    assert len(mesh.triangles) > 1000
    assert np.isfinite(mesh.positions).all()
    assert np.isfinite(mesh.normals).all()


def test_what_a_mask_covers_is_no_surface() -> None:
    used = np.ones((120, 160), np.bool_)
    used[:, :80] = False
    given = inputs()
    told = [message for message in given[topics.KEYFRAME] if isinstance(message, Keyframe)]
    given[topics.KEYFRAME] = [replace(message, mask=packed(used)) for message in told]
    vertices = final(run(given), "fine").positions
    assert len(vertices) > 500
    columns = [CAMERA.project(transform(inverse(pose(f)), vertices))[:, 0] for f in range(FRAMES)]
    assert np.max(columns, axis=0).min() > 78.0
    bare = final(run(inputs()), "fine").positions
    assert CAMERA.project(transform(inverse(pose(FRAMES - 1)), bare))[:, 0].min() < 20.0


def test_no_keyframes_no_mesh() -> None:
    empty = inputs()
    for topic in (topics.MAP_UPDATE, topics.KEYFRAME):
        empty[topic] = []
    empty[topics.KEYFRAME_FINAL] = [keyframe(0, -1, [])]
    assert run(empty) == {}


def test_a_volume_too_small_is_said_with_what_all_keyframes_need() -> None:
    def made(fine_voxel: float, limit_mb: int) -> tuple[set[str], list[str]]:
        monitor, bus = Notes(), ReplayBus(inputs())
        sets = (f"fine_voxel={fine_voxel}", "coarse_voxel=0.1", f"max_memory_mb={limit_mb}")
        config = load_config(None, [f"meshing.tsdf.{each}" for each in sets])
        meshing.run(bus, config, monitor)
        pieces = bus.outputs.get(topics.MESH_FINAL, [])
        return {m.level for m in pieces if isinstance(m, MeshPiece)}, monitor.notes

    limit = 12  # the first keyframe fits
    levels, notes = made(0.006, limit)
    assert levels == {"coarse"}
    (told,) = [note for note in notes if "no fine mesh" in note]
    assert "meshing.tsdf.fine_voxel=0.006 needs 13 MB for segment 0, the limit is 12 MB" in told
    assert made(0.006, 14)[0] == {"coarse", "fine"}
    # It is what all keyframes need, however few of them there was room for.
    (worse,) = [note for note in made(0.006, 3)[1] if "no fine mesh" in note]
    assert "needs 13 MB for segment 0, the limit is 3 MB" in worse
    for note, size in ((told, limit), (worse, 3)):
        fitting = float(note.split("about ")[1].split()[0])
        assert fitting > 0.006
        assert made(fitting, size)[0] == {"coarse", "fine"}


def test_where_no_keyframe_has_a_surface_it_is_said_why() -> None:
    monitor = Notes()
    nothing = replace(keyframe(FRAMES - 1, -1, []), keyframe_ids=np.arange(2, dtype=np.int64),
                      settled=np.ones(2, np.bool_), counts=np.zeros(2, np.int32))  # fmt: skip
    given = {
        **inputs(),
        topics.KEYFRAME: [keyframe(frame, -1, []) for frame in range(FRAMES)],
        topics.KEYFRAME_FINAL: [nothing],
    }
    assert topics.MESH_FINAL not in run(given, monitor)
    assert monitor.notes[-1] == (
        "no keyframe of segment 0 has a surface (keyframe 1: 0 points with depth)"
    )


def test_a_mesh_is_the_same_after_its_pieces(outputs: dict[Topic, list[Header]]) -> None:
    mesh = joined([final(outputs, "fine")])
    copies = 8
    big = replace(
        mesh, positions=np.tile(mesh.positions, (copies, 1)),
        normals=np.tile(mesh.normals, (copies, 1)), colours=np.tile(mesh.colours, (copies, 1)),
        triangles=np.concatenate([mesh.triangles + i * len(mesh.positions) for i in range(copies)]),
    )  # fmt: skip
    header = Header(frame=1, stamp_ns=2, frame_id="")
    told = list(split(header, big, segment=0, level="fine", voxel_size=0.1, keyframes=3))
    assert len(told) > 1
    again = joined(told)
    for name in ("positions", "normals", "colours", "triangles"):
        np.testing.assert_array_equal(getattr(again, name), getattr(big, name))


def test_the_spool_gives_back_what_it_got() -> None:
    with KeyframeSpool() as spool:
        ids, pixels = seen(0)
        spool.put_image(3, b"image")
        spool.put_observations(3, ids, pixels)
        spool.put_observations(1, ids[:5], pixels[:5])
        spool.put_observations(3, ids[:7], pixels[:7])
        assert spool.keyframes() == [1, 3]
        assert spool.image(3) == b"image"
        assert spool.image(1) == b""
        found = spool.observations(3)
        np.testing.assert_array_equal(found[0], ids[:7])
        np.testing.assert_array_equal(found[1], pixels[:7])
        size = spool.size_bytes
        assert size > 0
        spool.put_observations(3, ids[:6], pixels[:6])
        spool.put_image(1, b"")
        assert spool.size_bytes == size  # in the place of what was there
        np.testing.assert_array_equal(spool.observations(3)[0], ids[:6])
        assert spool.image(3) == b"image"


def test_a_surface_that_was_kept_gives_the_same_depths() -> None:
    generator = np.random.default_rng(0)
    drawn = DrawnTriangles(
        triangles=np.array([[0, 1, 2], [1, 3, 2]], np.int32),
        points_px=np.array([[3.3, 4.1], [150.7, 9.2], [20.1, 110.9], [140.2, 100.5]], np.float32),
        inverse_depths=generator.uniform(0.2, 0.3, 4).astype(np.float32),
        sigmas=generator.uniform(0.001, 0.002, 4).astype(np.float32),
    )
    with KeyframeSpool() as spool:
        spool.put_surface(7, drawn)
        one, other = drawn.depth_map(CAMERA), spool.surface(7).depth_map(CAMERA)
    assert np.count_nonzero(one.depths) > 1000
    np.testing.assert_array_equal(other.depths, one.depths)
    np.testing.assert_array_equal(other.weights, one.weights)


MET, JOINED = 2, 4
"""Frames: from MET on the camera is in another segment, until it is known where that lies."""


def two_segments() -> Inputs:
    """The same keyframes; those of a second segment at twice the size, with points of its own."""
    given = inputs()
    T = looking_aside()
    larger = T @ np.diag([2.0, 2.0, 2.0, 1.0])
    first = map_update(0)
    own = {
        "point_ids": first.point_ids + POINTS, "point_segments": np.ones(POINTS, np.int32),
        "points_world": transform(larger, first.points_world),
        "point_hosts": np.full(POINTS, MET),
    }  # fmt: skip
    for frame in range(MET, FRAMES):
        update = map_update(frame)
        if frame < JOINED:
            there = matrix_to_pose(move_by_similarity(larger, pose(frame))[None])
            one = np.ones(1, np.int32)
            update = replace(update, segment=1, keyframe_segments=one, keyframe_poses=there)
        if frame == MET:
            points = {name: getattr(first, name) for name in vars(first) if "point" in name}
            update = replace(update, **points | own)
        if frame == JOINED:
            back = inverse(T)
            back[:3, 3] *= 0.5
            update = replace(
                update, joined=np.array([[1, 0]], np.int32), moved_keyframes=np.array([MET]),
                moves=np.append(matrix_to_pose(back), 0.5)[None],
            )  # fmt: skip
        given[topics.MAP_UPDATE][frame] = update
    for topic in (topics.KEYFRAME, topics.KEYFRAME_FINAL):
        given[topic] = [seeing_its_own(message) for message in given[topic]]
    return given


def looking_aside() -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]], (1.0, 2.0, 3.0)
    return T


def seeing_its_own(message: Header, last: int = FRAMES) -> Keyframe:
    """Keyframes of the second segment, and later ones before the last, see the points of that."""
    assert isinstance(message, Keyframe)
    second = (message.keyframe_ids >= MET) & (message.keyframe_ids < last)
    own = np.repeat(second, message.counts)
    return replace(message, point_ids=message.point_ids + POINTS * own)


def live(made: dict[Topic, list[Header]], segment: int) -> TriangleMesh:
    """The last mesh that a viewer has of a segment."""
    held = BlockMesh()
    for message in made[topics.MESH_BLOCKS]:
        assert isinstance(message, MeshUpdate)
        if message.segment == segment:
            held.apply(message)
        else:
            held = BlockMesh()
    return held.mesh()


def test_segments_that_were_joined_are_one_mesh(outputs: dict[Topic, list[Header]]) -> None:
    made = run(two_segments())
    for level in ("fine", "coarse"):
        one, alone = final(made, level), final(outputs, level)
        assert (one.segment, one.keyframes) == (0, FRAMES)
        assert len(one.triangles) == pytest.approx(len(alone.triangles), rel=0.05)
        assert one.positions[:, 2].max() < 4.1
    # Its voxels are those of the first keyframe that was fused, which is another one.
    triangles = len(live(outputs, 0).triangles)
    assert len(live(made, 0).triangles) == pytest.approx(triangles, rel=0.2)


def test_a_segment_that_goes_on_has_its_mesh_again(outputs: dict[Topic, list[Header]]) -> None:
    """The camera is recognised in the first of two segments: the keyframes from before that only
    they saw the left of the wall."""
    given = two_segments()
    update = given[topics.MAP_UPDATE][JOINED]
    assert isinstance(update, MapUpdate)
    nothing = map_update(JOINED)
    given[topics.MAP_UPDATE][JOINED] = nothing
    for topic in (topics.KEYFRAME, topics.KEYFRAME_FINAL):
        given[topic] = [seeing_its_own(message, last=JOINED) for message in inputs()[topic]]
    found, whole = live(run(given), 0).positions, live(outputs, 0).positions
    np.testing.assert_allclose(found.min(axis=0), whole.min(axis=0), atol=0.05)


DRIFT = 0.6
"""Three coarse voxels."""
QUIET = 6
"""Frames at the end that are no keyframes."""


def a_loop() -> Inputs:
    """The wall lies DRIFT farther away from MET on, cameras and all, until a loop is closed."""
    given = inputs()
    first, away = map_update(0), np.array([0.0, 0.0, DRIFT])
    for frame in range(MET, FRAMES):
        update = map_update(frame)
        poses = update.keyframe_poses + np.append(away, np.zeros(4))
        update = replace(update, keyframe_poses=poses)
        if frame == MET:
            points = {name: getattr(first, name) for name in vars(first) if "point" in name}
            points["point_ids"] = first.point_ids + POINTS
            points["points_world"] = first.points_world + away
            points["point_hosts"] = np.full(POINTS, MET)
            update = replace(update, **points)
        given[topics.MAP_UPDATE][frame] = update
    quiet = range(FRAMES, FRAMES + QUIET)
    given[topics.MAP_UPDATE] += [map_update(frame, last=True) for frame in quiet]
    given[topics.KEYFRAME] += [keyframe(frame, -1, []) for frame in quiet]
    closes = given[topics.MAP_UPDATE][FRAMES]
    assert isinstance(closes, MapUpdate)
    back = np.eye(4)
    back[:3, 3] = -away
    given[topics.MAP_UPDATE][FRAMES] = replace(
        closes, moved_keyframes=np.array([MET]), moves=np.append(matrix_to_pose(back), 1.0)[None]
    )
    for topic in (topics.KEYFRAME, topics.KEYFRAME_FINAL):
        given[topic] = [seeing_its_own(message) for message in given[topic]]
    return given


def test_a_live_mesh_follows_a_loop(outputs: dict[Topic, list[Header]]) -> None:
    def followed(way: str) -> tuple[dict[Topic, list[Header]], list[float]]:
        bus, monitor = ReplayBus(a_loop()), Notes()
        meshing.run(bus, load_config(None, [f"meshing.corrections={way}"]), monitor)
        return bus.outputs, monitor.again

    made, again = followed("moved")
    found, true = live(made, 0), live(outputs, 0)
    assert found.positions[:, 2].max() < 4.1
    for one, other in ((found, true), (true, found)):
        apart = np.linalg.norm(one.positions[:, None] - other.positions[None], axis=2).min(axis=1)
        # At its rims the surface ends a voxel earlier or later.
        assert np.percentile(apart, 95) < 0.05 * VOXEL
        assert apart.max() < 1.1 * VOXEL
    assert len(found.triangles) == pytest.approx(len(true.triangles), rel=0.1)
    # One a frame, those that had left the window among them, and each once.
    assert np.diff(again).max() == 1.0
    assert again[-1] == FRAMES - MET
    stayed, none = followed("settled")
    assert live(stayed, 0).positions[:, 2].max() > 4.0 + DRIFT - 0.1
    assert none[-1] == 0.0
    for topic in (topics.MESH_BLOCKS, topics.MESH_FINAL):
        told = [codec.encode(message) for message in made[topic]]
        assert [codec.encode(message) for message in followed("moved")[0][topic]] == told
    assert [codec.encode(message) for message in stayed[topics.MESH_FINAL]] == told
