"""Surfels that start on our own map, or on a plane, and that are told where tracks went."""

from dataclasses import replace

import numpy as np
import pytest

from pliant.algorithms.arrays import F64
from pliant.algorithms.surfels import SurfelState
from pliant.bus.replay_bus import ReplayBus
from pliant.config import Config, load_config
from pliant.datasets import open_source
from pliant.datasets.calibration import calibration_from_yaml
from pliant.datasets.depth import DepthRectifier
from pliant.errors import ConfigError
from pliant.messages import codec, topics
from pliant.messages.topics import Topic
from pliant.messages.types import CameraStream, Depth, Extrema, Header, Image, Keyframe, Surfels
from pliant_services import bundle_adjustment, ingest, surfels, tracking
from pliant_services.monitor import SilentMonitor
from pliant_services.processes import BY_NAME

FRAMES = 25
ALONE = BY_NAME["surfels"].inputs
OPTIONAL = BY_NAME["surfels"].optional
Messages = dict[Topic, list[Header]]
FROM_MAP = (
    "surfels.depth_from=map", "surfels.camera=moving", "surfels.max_surfels=60",
    "surfels.map_keyframes=3", "surfels.map_points=40", "surfels.map_sigma=0.03",
)  # fmt: skip


@pytest.fixture(scope="module")
def everything() -> Messages:
    """What all services of a fleet make of a rigid scene."""
    config, monitor = load_config(), SilentMonitor()
    source = ReplayBus({})
    dataset = open_source(f"built-in:tiny?frames={FRAMES}", depth="all")
    ingest.run(source, config, monitor, dataset, stopping=lambda: False)
    made = dict(source.outputs)
    for name, service in (("tracking", tracking), ("bundle_adjustment", bundle_adjustment)):
        bus = ReplayBus({topic: made[topic] for topic in BY_NAME[name].inputs})
        service.run(bus, config, monitor)
        made |= bus.outputs
    return made


def follow(config: Config, made: Messages, *reads: Topic) -> list[Surfels]:
    bus = ReplayBus({topic: made[topic] for topic in (*ALONE, *reads)})
    surfels.run(bus, config, SilentMonitor())
    return [m for m in bus.outputs[topics.SURFELS] if isinstance(m, Surfels)]


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
    assert all(m.missing.startswith(surfels.WAITING) for m in followed[: first.frame])
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


def test_the_same_again(everything: Messages) -> None:
    config = load_config(None, FROM_MAP)
    once, again = (follow(config, everything, *OPTIONAL) for _ in range(2))
    assert [codec.encode(m) for m in once] == [codec.encode(m) for m in again]


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


def test_tracks_tell_where_surfels_went(everything: Messages) -> None:
    """The image leaps by 12 px a frame: too far at full size for a surfel that is not told."""
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
    told = [*common, "surfels.prediction=tracks"]
    alone = follow(load_config(None, common), leaping)
    led = follow(load_config(None, told), leaping, topics.EXTREMA)
    assert np.count_nonzero(alone[1].state == SurfelState.TRACKED) < 0.3 * len(alone[1].ids)
    assert np.count_nonzero(led[-1].state == SurfelState.TRACKED) > 0.8 * len(led[-1].ids)


@pytest.mark.parametrize("setting", ["surfels.depth_from=map", "surfels.prediction=tracks"])
def test_what_nobody_publishes_is_said_at_once(everything: Messages, setting: str) -> None:
    with pytest.raises(ConfigError, match=f"{setting}: nobody here publishes"):
        follow(load_config(None, [setting]), everything)
