"""The meshing service on the in-memory bus: what it sends, that it is the same again, bad input."""

from collections.abc import Callable, Iterator
from dataclasses import replace

import cv2
import numpy as np
import pytest
from meshing_scene import (
    CAMERA,
    FRAMES,
    Inputs,
    Notes,
    final,
    inputs,
    keyframe,
    map_update,
    pose,
    run,
    seen,
)

from pliant.algorithms.geometry import inverse, transform
from pliant.algorithms.image.masks import packed
from pliant.algorithms.meshing.mesh_blocks import BlockMesh
from pliant.algorithms.meshing.parameters import MeshingParameters
from pliant.algorithms.meshing.rendering import DrawnTriangles
from pliant.bus.replay_bus import ReplayBus
from pliant.config import load_config
from pliant.fusion import voxel_file
from pliant.fusion.keyframe_spool import KeyframeSpool
from pliant.messages import codec, topics
from pliant.messages.mesh_pieces import joined, split
from pliant.messages.topics import Topic
from pliant.messages.types import Header, Keyframe, MapUpdate, MeshPiece, MeshUpdate
from pliant_services.nodes import meshing


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
def test_only_the_segment_of_the_last_adjustment_has_the_corrected_camera(
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


def with_texture(given: Inputs) -> Inputs:
    """Each keyframe shows the same waves on the wall and on the box."""
    columns = np.arange(160)
    for frame, told in enumerate(given[topics.KEYFRAME]):
        assert isinstance(told, Keyframe)
        rays = (columns - CAMERA.cx) / CAMERA.fx
        x = np.where(np.abs(3.0 * rays + pose(frame)[0, 3]) < 0.7, 3.0, 4.0) * rays
        x = x + pose(frame)[0, 3]
        waves = 60.0 * np.sin(25.0 * x) + 40.0 * np.sin(41.0 * x + 1.0)
        image = np.tile(np.rint(128.0 + waves).astype(np.uint8), (120, 1))
        jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes()
        given[topics.KEYFRAME][frame] = replace(told, jpeg=jpeg)
    return given


def fewer_points(given: Inputs) -> Inputs:
    """Every twelfth observation of each keyframe."""
    for topic in (topics.KEYFRAME, topics.KEYFRAME_FINAL):
        for row, told in enumerate(given[topic]):
            assert isinstance(told, Keyframe)
            keyframes = np.repeat(np.arange(len(told.counts)), told.counts)
            kept = told.point_ids % 12 == 0
            counts = np.bincount(keyframes[kept], minlength=len(told.counts)).astype(np.int32)
            given[topic][row] = replace(
                told, counts=counts, point_ids=told.point_ids[kept], points_px=told.points_px[kept]
            )
    return given


def test_what_images_agree_on_is_in_the_final_mesh_and_not_in_the_live_one() -> None:
    dense, points = (
        run(with_texture(fewer_points(inputs())), settings=[f"meshing.depth={depth}"])
        for depth in ("dense", "points")
    )
    assert [codec.encode(m) for m in dense[topics.MESH_BLOCKS]] == [
        codec.encode(m) for m in points[topics.MESH_BLOCKS]
    ]
    found: list[int] = []
    for made in (dense, points):
        z = final(made, "fine").positions[:, 2]
        distance = np.minimum(np.abs(z - 3.0), np.abs(z - 4.0))
        found.append(int(np.count_nonzero(distance < 0.02)))
    assert found[0] > 1.1 * found[1]


def test_dense_depth_of_the_live_mesh_has_the_same_bytes_again_and_leaves_the_final_one() -> None:
    def made(depth: str) -> list[list[bytes]]:
        settings = [f"meshing.live_depth={depth}"]
        outputs = run(with_texture(fewer_points(inputs())), settings=settings)
        return [
            [codec.encode(m) for m in outputs[topic]]
            for topic in (topics.MESH_BLOCKS, topics.MESH_FINAL)
        ]

    dense, points = made("dense"), made("points")
    assert dense == made("dense")
    assert dense[0] != points[0]
    assert dense[1] == points[1]


def test_what_no_keyframe_has_a_surface_of_is_filled_faintly() -> None:
    found: list[int] = []
    for least in (0.01, 0.1):
        settings = [f"meshing.tsdf.dense_min_weight={least}"]
        z = final(run(with_texture(fewer_points(inputs())), settings=settings), "fine").positions
        distance = np.minimum(np.abs(z[:, 2] - 3.0), np.abs(z[:, 2] - 4.0))
        found.append(int(np.count_nonzero(distance < 0.02)))
    assert found[0] > 1.06 * found[1]  # 1.02 by what is seen faintly


def test_the_final_surface_has_its_own_weight_of_slopes() -> None:
    dense, points = (MeshingParameters(depth=depth) for depth in ("dense", "points"))
    assert points.final_surface == points.surface
    expected = points.surface.nltgv.dense_slope_weight
    assert dense.final_surface.nltgv.slope_weight == expected
    assert expected < points.final_surface.nltgv.slope_weight
    assert dense.final_surface.triangles == dense.surface.triangles


def test_without_texture_the_mesh_is_that_of_the_points() -> None:
    points = run(inputs(), settings=["meshing.depth=points"])
    same = "meshing.surface.nltgv.dense_slope_weight=3"
    dense = run(inputs(), settings=["meshing.finish=false", same])
    for level in ("fine", "coarse"):
        assert codec.encode(final(points, level)) == codec.encode(final(dense, level))


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


def test_a_volume_too_small_is_said_with_what_all_keyframes_need(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(voxel_file, "_SHARE_OF_FREE", 0.0)

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
    assert "meshing.tsdf.fine_voxel=0.006 needs 13 MB for segment 0, " in told
    assert "half of the free disk have room for 12 MB" in told
    assert made(0.006, 14)[0] == {"coarse", "fine"}
    # It is what all keyframes need, however few of them there was room for.
    (worse,) = [note for note in made(0.006, 3)[1] if "no fine mesh" in note]
    assert "needs 13 MB for segment 0, " in worse
    assert "have room for 3 MB" in worse
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
