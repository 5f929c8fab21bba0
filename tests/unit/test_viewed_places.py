"""What viewers and readers of updates learn of places that are seen again."""

import json
from dataclasses import replace
from typing import Any, cast

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.geometry import matrix_to_pose
from pliant.algorithms.map_delta import TRACKING, MapDelta, MapMoves
from pliant.algorithms.slam.journal import Journal, Outcome
from pliant.algorithms.slam.map.keyframe import Keyframe
from pliant.algorithms.slam.map.landmarks import Landmarks
from pliant.map_history import MapHistory
from pliant.messages import topics
from pliant.messages.types import Header, MapUpdate
from pliant.results.page.scene import make_scene
from pliant.viewers.canvas import Canvas
from pliant.viewers.drawn_scene import Scene


class Drawn:
    """A canvas that holds the lines that are on it, and what was said."""

    def __init__(self) -> None:
        self.lines: dict[int, F64] = {}
        self.said: list[str] = []

    def places(self, _: object, segment: int, lines: F64) -> None:
        self.lines[segment] = lines

    def forget(self, _: object, segment: int) -> None:
        self.lines.pop(segment, None)

    def note(self, _: object, text: str) -> None:
        self.said.append(text)

    def __getattr__(self, name: str) -> Any:
        return self._ignore

    def _ignore(self, *_: object) -> None:
        return None


def keyframe(number: int, segment: int, x: float) -> Keyframe:
    pose = np.eye(4)
    pose[0, 3] = x
    px = np.zeros((0, 2), np.float32)
    return Keyframe(
        id=number, frame=10 * number, segment=segment, T_world_camera=pose,
        rows=np.zeros(0, np.int32), points_px=px, rolled_px=px,
    )  # fmt: skip


def update(changes: Journal, segment: int, keyframes: list[Keyframe], **others: Any) -> MapDelta:
    changes.add_changed(keyframes, np.zeros(0, np.int32))
    delta = changes.publish(Outcome(TRACKING, "", 99, segment, np.zeros(3), snapshot=True))
    return replace(delta, **others)


class Viewed:
    def __init__(self) -> None:
        self.drawn = Drawn()
        self.scene = Scene(cast(Canvas, self.drawn))
        self.frames = 0

    def take(self, delta: MapDelta, frame: int) -> None:
        """An update; points and lines are drawn with every tenth frame."""
        header = Header(frame=frame, stamp_ns=frame, frame_id="world")
        self.scene.take(topics.MAP_UPDATE, MapUpdate.of(header, delta), self.frames, 0)
        self.frames += 1


def test_a_viewer_shows_a_loop_as_it_closes_and_moves_it_with_the_map() -> None:
    viewed, changes = Viewed(), Journal(Landmarks())
    keyframes = [keyframe(k, 0, float(k)) for k in range(4)]
    viewed.take(update(changes, 0, keyframes), 30)
    assert not viewed.drawn.lines
    changes.add_same_places([(0, 2), (1, 3)])
    viewed.take(update(changes, 0, keyframes), 60)
    (lines,) = viewed.drawn.lines.values()
    np.testing.assert_array_equal(lines[:, :, 0], [(0, 2), (1, 3)])
    assert viewed.drawn.said == [
        "loop closed: frame 20 shows the place of frame 0",
        "loop closed: frame 30 shows the place of frame 10",
    ]
    there = np.eye(4)
    there[1, 3] = 5.0
    changes.move(
        MapMoves(
            keyframe_ids=np.array([3], np.int64),
            moves=np.append(matrix_to_pose(there), 1.0)[None],
        )
    )
    viewed.take(update(changes, 0, []), 90)
    np.testing.assert_array_equal(viewed.drawn.lines[0][:, :, 1], [(0, 0), (0, 5)])


def test_a_viewer_shows_where_a_lost_camera_is_recognised() -> None:
    viewed, changes = Viewed(), Journal(Landmarks())
    viewed.take(update(changes, 0, [keyframe(k, 0, float(k)) for k in range(3)]), 20)
    changes.add_same_places([(1, 5)])
    viewed.take(update(changes, 0, [keyframe(5, 0, 1.5)]), 50)
    assert viewed.drawn.said == ["recognised: frame 50 shows the place of frame 10"]
    assert viewed.drawn.lines[0].shape == (1, 2, 3)
    changes.add_same_places([(2, -1)])  # a frame of a run that only localises
    viewed.take(update(changes, 0, []), 67)
    assert viewed.drawn.said[1:] == ["recognised: frame 67 shows the place of frame 20"]
    assert viewed.drawn.lines[0].shape == (1, 2, 3)


def test_a_viewer_shows_what_joins_two_segments_once() -> None:
    viewed, changes = Viewed(), Journal(Landmarks())
    viewed.take(update(changes, 0, [keyframe(0, 0, 0.0)]), 0)
    viewed.take(update(changes, 1, [keyframe(7, 1, 7.0)]), 70)
    changes.join(1, 0)
    changes.add_same_places([(0, 7)])
    viewed.take(update(changes, 0, [keyframe(7, 0, 7.0)]), 90)
    assert viewed.drawn.said == ["segment 1 joined to 0: frame 70 shows the place of frame 0"]
    np.testing.assert_array_equal(viewed.drawn.lines[0][:, :, 0], [(0, 7)])
    changes.add_same_places([(0, 7)])  # what was left between the two has been spread
    viewed.take(update(changes, 0, []), 120)
    assert len(viewed.drawn.said) == 1


def test_results_have_the_places_and_the_page_draws_them() -> None:
    history, changes = MapHistory(), Journal(Landmarks())
    history.apply(update(changes, 0, [keyframe(0, 0, 0.0)]), frame=0, stamp_ns=0)
    changes.add_same_places([(0, 4), (0, -1)])
    history.apply(update(changes, 0, [keyframe(4, 0, 4.0)]), frame=40, stamp_ns=40)
    changes.add_same_places([(0, 4)])
    history.apply(update(changes, 0, []), frame=50, stamp_ns=50, final=True)
    assert history.same_places == [(0, 4)]
    poses = np.array([np.eye(4)] * 3)
    points, colours = np.zeros((5, 3)), np.zeros((5, 3), np.uint8)
    lines = np.array([[(0.0, 0.0, 0.0), (4.0, 0.0, 0.0)]])
    layers = json.loads(make_scene(points, colours, poses, None, lines).header)["layers"]
    assert [layer["name"] for layer in layers] == ["points", "path", "places"]
    assert layers[-1]["count"] == 2
    assert layers[-1]["pairs"]
    layers = json.loads(make_scene(points, colours, poses, None, lines[:0]).header)["layers"]
    assert [layer["name"] for layer in layers] == ["points", "path"]
