"""Surfels that start on our own map, or on a plane, and that are told where tracks went."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from restarting import Restarted, Stopping

from pliant.algorithms.arrays import F64, BoolArray
from pliant.algorithms.deformable.moving_landmarks import WindowMap
from pliant.algorithms.geometry import inverse, pose_to_matrix, transform
from pliant.algorithms.image.masks import packed
from pliant.algorithms.surfels.remembered_views import RememberedViews
from pliant.algorithms.surfels.surfel_frame import SurfelState
from pliant.bus.replay_bus import ReplayBus
from pliant.config import Config, load_config
from pliant.datasets import open_source
from pliant.datasets.calibration import calibration_from_yaml
from pliant.datasets.depth import DepthRectifier
from pliant.datasets.source_spec import SourceSpec
from pliant.errors import ConfigError
from pliant.map_history import CurrentMap
from pliant.messages import codec, topics
from pliant.messages.topics import Topic
from pliant.messages.types import (
    WAITING_FOR_DEPTH,
    WORLD_FRAME_ID,
    CameraStream,
    DeformingLandmarks,
    Depth,
    Extrema,
    Header,
    Image,
    Keyframe,
    MapUpdate,
    Surfels,
)
from pliant_services.nodes import (
    bundle_adjustment,
    deformable_mapping,
    ingest,
    surfels,
    tracking,
)
from pliant_services.processes import BY_NAME
from pliant_services.runtime.monitor import SilentMonitor

SOURCE = "built-in:breathing?amplitude=0&travel=0.25&width=320"
FRAMES = 25
ALONE = BY_NAME["surfels"].inputs
OPTIONAL = BY_NAME["surfels"].optional
Messages = dict[Topic, list[Header]]
FROM_MAP = (
    "surfels.depth_from=map", "surfels.camera=moving", "surfels.max_surfels=60",
    "surfels.map_keyframes=3", "surfels.map_points=40", "surfels.map_sigma=0.03",
)  # fmt: skip
LATER = (*FROM_MAP, "surfels.max_surfels=250", "surfels.map_birth_sigma=0.03")


@pytest.fixture(scope="module")
def everything() -> Messages:
    """What all services of a fleet make of a rigid scene that comes into view."""
    config, monitor = load_config(), SilentMonitor()
    source = ReplayBus({})
    dataset = open_source(SourceSpec(location=f"{SOURCE}&frames={FRAMES}", depth="all"))
    ingest.run(source, config, monitor, dataset, stopping=lambda: False)
    made = dict(source.outputs)
    for service in (tracking, bundle_adjustment, deformable_mapping):
        name = service.__name__.rpartition(".")[2]
        bus = ReplayBus({topic: made[topic] for topic in BY_NAME[name].inputs})
        service.run(bus, config, monitor)
        made |= bus.outputs
    return made


def follow(config: Config, made: Messages, *reads: Topic) -> list[Surfels]:
    bus = ReplayBus({topic: made[topic] for topic in (*ALONE, *reads)})
    surfels.run(bus, config, SilentMonitor())
    return [m for m in bus.outputs[topics.SURFELS] if isinstance(m, Surfels)]


@pytest.fixture(scope="module")
def followed(everything: Messages) -> list[Surfels]:
    """Surfels of our own map, born later, too."""
    return follow(load_config(None, LATER), without_depth(everything), *OPTIONAL)


def without_depth(made: Messages) -> Messages:
    depths = [replace(m, data=b"") for m in made[topics.DEPTH] if isinstance(m, Depth)]
    return {**made, topics.DEPTH: list(depths)}


def true_depth(made: Messages, frame: int) -> F64:
    stream, depth = made[topics.STREAM][0], made[topics.DEPTH][frame]
    assert isinstance(stream, CameraStream)
    assert isinstance(depth, Depth)
    return DepthRectifier(calibration_from_yaml(stream.calibration)).rectify(frame, depth.data)


def test_surfels_start_on_a_keyframe_of_our_own_map(everything: Messages) -> None:
    followed = follow(load_config(None, FROM_MAP), without_depth(everything), *OPTIONAL)
    assert [m.frame for m in followed] == list(range(FRAMES))
    first = next(m for m in followed if not m.missing)
    assert 0 < first.frame < FRAMES - 1
    assert all(m.missing.startswith(WAITING_FOR_DEPTH) for m in followed[: first.frame])
    keyframes = [m for m in everything[topics.KEYFRAME] if isinstance(m, Keyframe)]
    assert first.frame in [m.frame for m in keyframes if m.new >= 0]
    assert len(first.ids) > 20
    # The depths are true but for the one scale that a camera alone cannot know.
    T = first.T_world_camera
    depth = ((first.positions - T[:3, 3]) @ T[:3, :3])[:, 2]
    column, row = np.rint(first.points_px).astype(int).T
    shares = true_depth(everything, first.frame)[row, column] / depth
    assert np.median(np.abs(shares / np.median(shares) - 1.0)) < 0.02
    assert np.count_nonzero(followed[-1].state == SurfelState.TRACKED) > 0.5 * len(first.ids)


def test_the_first_window_is_laid_on_the_frame_in_which_surfels_started(
    everything: Messages,
) -> None:
    """Which need be no keyframe of the window; later cameras of surfels may be wrong."""
    config, made = load_config(None, FROM_MAP), without_depth(everything)
    without = [m for m in follow(config, made, *OPTIONAL) if not m.missing]
    first, last = without[0], without[-1]
    T = np.stack([np.eye(4), first.T_world_camera, last.T_world_camera])
    T[2, 0, 3] += 0.05
    there = transform(inverse(last.T_world_camera), last.positions)
    count = len(there)
    window = DeformingLandmarks.of(
        last,
        WindowMap(
            frames=np.array([first.frame - 1, last.frame]),
            T_world_camera=T[[0, 2]],
            ids=np.arange(count),
            points_px=last.points_px,
            rest=transform(T[2], there),
            displacements=np.zeros((2, 1, 3)),
            carriers=np.zeros((count, 4), np.int64),
            weights=np.full((count, 4), 0.25),
            between=np.array([first.frame]),
            T_between=T[1:2],
        ),
        frame_id=WORLD_FRAME_ID,
    )
    windows = [*made[topics.MAP_DEFORMING][: last.frame], window]
    placed = follow(config, {**made, topics.MAP_DEFORMING: windows}, *OPTIONAL)[-1]
    np.testing.assert_allclose(placed.T_world_camera, T[2], atol=1e-3)


def test_no_surfel_lies_under_a_mask(everything: Messages) -> None:
    images = [m for m in everything[topics.IMAGE] if isinstance(m, Image)]
    used = np.ones(images[0].grey.shape, np.bool_)
    middle = used.shape[1] // 2
    used[:, :middle] = False
    covered = list[Header](
        replace(m, mask=packed(used if m.frame < 5 else used[:, ::-1])) for m in images[:8]
    )
    made = {topic: messages[:8] for topic, messages in everything.items()}
    followed = follow(load_config(), {**made, topics.IMAGE: covered})
    for message in followed:
        right = message.points_px[:, 0] >= middle
        seen = message.state == SurfelState.TRACKED
        assert not seen[~right if message.frame < 5 else right].any()
    assert len(followed[0].ids) > 20


def born_later(followed: list[Surfels]) -> dict[int, Surfels]:
    """Frames after the start in which surfels were born."""
    started = [m for m in followed if not m.missing]
    return {m.frame: m for m in started[1:] if (m.age == 0).any()}


def shares_of_truth(made: Messages, message: Surfels, rows: BoolArray) -> F64:
    """True depth by the depth of surfels at their pixels."""
    T = message.T_world_camera
    depth = ((message.positions[rows] - T[:3, 3]) @ T[:3, :3])[:, 2]
    column, row = np.rint(message.points_px[rows]).astype(int).T
    return true_depth(made, message.frame)[row, column] / depth


def with_map(made: Messages, after: int, change: Callable[[F64, F64], F64]) -> Messages:
    """From a frame on each update tells of the whole map, with points (N, 3) moved by ``change``.

    change: is given the points and T_world_camera of the keyframe that was new last.
    """
    known, updates, new = CurrentMap(), list[Header](), -1
    for update, keyframe in zip(made[topics.MAP_UPDATE], made[topics.KEYFRAME], strict=True):
        assert isinstance(update, MapUpdate)
        assert isinstance(keyframe, Keyframe)
        known.take(update, update.frame)
        new = keyframe.new if keyframe.new >= 0 else new
        if update.frame <= after:
            updates.append(update)
            continue
        points = known.points()
        T = pose_to_matrix(known.keyframes[new].pose_world_camera)
        poses = np.array([k.pose_world_camera for k in known.keyframes.values()])
        poses[:, :3] = change(poses[:, :3], T)
        keyframes = known.keyframes.values()
        updates.append(
            replace(
                update,
                keyframe_ids=np.array(list(known.keyframes), np.int64),
                keyframe_frames=np.array([k.frame for k in keyframes], np.int64),
                keyframe_segments=np.array([k.segment for k in keyframes], np.int32),
                keyframe_poses=poses,
                point_ids=points.ids,
                point_segments=points.segments,
                points_world=change(points.positions, T),
                point_colours=points.colours,
                point_keyframes=points.keyframes,
                point_parallax_rad=points.parallax_rad,
                point_sigmas=points.sigmas,
                point_hosts=np.full(len(points.ids), min(known.keyframes)),
            )
        )
    return {**made, topics.MAP_UPDATE: updates}


def test_surfels_are_born_later_on_our_own_map(
    everything: Messages, followed: list[Surfels]
) -> None:
    births = born_later(followed)
    keyframes = [m for m in everything[topics.KEYFRAME] if isinstance(m, Keyframe)]
    assert births
    assert set(births) <= {m.frame for m in keyframes if m.new >= 0}
    start = next(m for m in followed if not m.missing)
    scale = np.median(shares_of_truth(everything, start, np.ones(len(start.ids), np.bool_)))
    shares = [shares_of_truth(everything, m, m.age == 0) for m in births.values()]
    assert sum(map(len, shares)) >= 10
    assert np.median(np.abs(np.concatenate(shares) / scale - 1.0)) < 0.02
    # They are followed from then on.
    frame, born = min(births.items())
    later = next(m for m in followed if m.frame == frame + 2)
    mine = np.isin(later.ids, born.ids[born.age == 0])
    assert (later.state[mine] == SurfelState.TRACKED).mean() > 0.7


def test_a_map_of_another_scale_is_brought_to_that_of_the_surfels(
    everything: Messages, followed: list[Surfels]
) -> None:
    """A world half as large, from the frame after the start on, makes the same surfels."""
    config, made = load_config(None, LATER), without_depth(everything)
    start = next(m.frame for m in followed if not m.missing)
    halved = follow(config, with_map(made, start, lambda points, _: 0.5 * points), *OPTIONAL)
    assert born_later(followed).keys() == born_later(halved).keys() != set()
    for one, other in zip(followed, halved, strict=True):
        np.testing.assert_array_equal(one.ids, other.ids)
        np.testing.assert_allclose(one.positions, other.positions, rtol=1e-3, atol=1e-3)


def test_nothing_is_born_on_a_map_that_surfels_do_not_agree_with(
    everything: Messages, followed: list[Surfels]
) -> None:
    """Points lie on the rays of the keyframe, and the nearer the further to the right."""

    def bent(points: F64, T: F64) -> F64:
        rays = points - T[:3, 3]
        in_camera = rays @ T[:3, :3]
        with np.errstate(all="ignore"):
            along = np.nan_to_num(in_camera[:, :1] / in_camera[:, 2:])
        return T[:3, 3] + rays * (1.0 + 0.5 * np.clip(along, -0.8, 0.8))

    config, made = load_config(None, LATER), without_depth(everything)
    start = next(m.frame for m in followed if not m.missing)
    wrong = follow(config, with_map(made, start, bent), *OPTIONAL)
    assert born_later(followed)
    assert not born_later(wrong)
    assert any("agree with it" in m.note for m in wrong)
    assert wrong[-1].ids.tolist() == wrong[start].ids.tolist()


def test_after_a_loss_surfels_start_again_on_our_own_map(
    everything: Messages, followed: list[Surfels]
) -> None:
    """At the scale they had, from where the map says that the camera is."""
    config, made = load_config(None, LATER), without_depth(everything)
    images = list(made[topics.IMAGE])
    again = min(born_later(followed))
    image = images[again]
    assert isinstance(image, Image)
    # The image is another one to the surfels, and not to the map.
    images[again] = replace(image, grey=np.ascontiguousarray(image.grey[:, ::-1]))
    after = follow(config, {**made, topics.IMAGE: images}, *OPTIONAL)[again]
    assert not after.lost
    assert after.segment == 1
    assert (after.age == 0).all()
    # The world is that of the start, as far as the map still knows it.
    known = CurrentMap()
    for update in made[topics.MAP_UPDATE][: again + 1]:
        assert isinstance(update, MapUpdate)
        known.take(update, update.frame)
    pose = next(
        pose_to_matrix(k.pose_world_camera) for k in known.keyframes.values() if k.frame == again
    )
    np.testing.assert_array_equal(after.T_world_camera[:3, :3], pose[:3, :3])
    np.testing.assert_allclose(after.T_world_camera[:3, 3], pose[:3, 3], atol=0.01)
    depths = [
        np.median(((m.positions - m.T_world_camera[:3, 3]) @ m.T_world_camera[:3, :3])[:, 2])
        for m in (followed[again], after)
    ]
    assert depths[1] == pytest.approx(depths[0], rel=0.1)


def test_a_service_that_is_started_again_knows_the_map(
    everything: Messages, followed: list[Surfels]
) -> None:
    config, made = load_config(None, LATER), without_depth(everything)
    inputs = {topic: made[topic] for topic in (*ALONE, *OPTIONAL)}
    before = min(born_later(followed)) - 1
    kept = Stopping(inputs, before)
    surfels.run(kept, config, SilentMonitor())
    rest = {t: m if t == topics.STREAM else m[before + 1 :] for t, m in inputs.items()}
    continued = Restarted({**rest, topics.STREAM: []}, kept.state)
    surfels.run(continued, config, SilentMonitor())
    made_then = continued.outputs[topics.SURFELS]
    assert [codec.encode(m) for m in made_then] == [codec.encode(m) for m in followed[before + 1 :]]


def test_the_same_again(everything: Messages, followed: list[Surfels]) -> None:
    """Also where there is depth that nobody has asked for."""
    again = follow(load_config(None, LATER), everything, *OPTIONAL)
    assert born_later(followed)
    assert [codec.encode(m) for m in followed] == [codec.encode(m) for m in again]


def test_a_map_that_is_never_good_enough_is_named(everything: Messages) -> None:
    config = load_config(None, [*FROM_MAP, "surfels.map_points=100000"])
    last = follow(config, everything, *OPTIONAL)[-1]
    assert "the scene hold nearly still" in last.missing
    assert len(last.ids) == 0


def test_without_any_depth_surfels_start_on_a_plane(everything: Messages) -> None:
    config = load_config(None, ["surfels.depth_from=flat", "surfels.max_surfels=60"])
    followed = follow(config, without_depth(everything))
    assert not followed[0].missing
    np.testing.assert_allclose(followed[0].positions[:, 2], 1.0)
    assert len(followed[0].ids) > 20


def test_tracks_predict_the_motion_of_surfels(
    everything: Messages, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The image leaps by 12 px a frame: too far at full size for a surfel that is not told."""
    monkeypatch.setattr(RememberedViews, "recognise", lambda *_: None)  # else they are found back
    leaping: Messages = {**everything, topics.IMAGE: [], topics.EXTREMA: []}
    image, tracks = everything[topics.IMAGE][0], everything[topics.EXTREMA][0]
    assert isinstance(image, Image)
    assert isinstance(tracks, Extrema)
    for frame in range(4):
        grey = np.roll(image.grey, 12 * frame, axis=1)
        points = tracks.points_px + np.array([12 * frame, 0], np.float32)
        leaping[topics.IMAGE].append(replace(image, frame=frame, grey=grey))
        leaping[topics.EXTREMA].append(replace(tracks, frame=frame, points_px=points))
    rest = without_depth(everything)[topics.DEPTH][1:4]
    leaping[topics.DEPTH] = [everything[topics.DEPTH][0], *rest]  # nothing is born later
    common = ["surfels.max_surfels=60", "surfels.levels=1", "surfels.neighbours=0"]
    alone = follow(load_config(None, common), leaping)
    led = follow(load_config(None, common), leaping, topics.EXTREMA)
    assert np.count_nonzero(alone[1].state == SurfelState.TRACKED) < 0.3 * len(alone[1].ids)
    assert np.count_nonzero(led[-1].state == SurfelState.TRACKED) > 0.8 * len(led[-1].ids)


def test_a_topic_without_a_publisher_fails_at_once(everything: Messages) -> None:
    setting = "surfels.depth_from=map"
    with pytest.raises(ConfigError, match=f"{setting}: no service of this session publishes"):
        follow(load_config(None, [setting]), everything)
