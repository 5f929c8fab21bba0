"""Scenes that look the same in more than one place: is any of them ever taken for another?

A pose is wrong where it is not that of the frame in the world of the first frames of its segment,
by more than half of what lies between two places that look alike.
"""

from collections.abc import Callable, Iterator
from copy import copy, deepcopy
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from benchmarks.deceiving_scenes import CAMERA, Deceiver, Film, Way, doors, floor, room_with, rooms
from benchmarks.table import markdown_header, markdown_row
from pliant.algorithms.arrays import F64, U8
from pliant.algorithms.geometry import pose_to_matrix
from pliant.algorithms.slam.adjust.loops import Loop
from pliant.algorithms.slam.atlas.known_places import KnownPlaces
from pliant.algorithms.slam.frame import Frame
from pliant.algorithms.slam.mapper import Mapper
from pliant.algorithms.tracking.tracker import ExtremaTracker
from pliant.config import Config
from pliant.map_history import MapHistory

_HEADER = (
    *("after the dark the camera sees", "runs", "frames", "found in the map", "wrong poses"),
    *("wrong in segments of their own", "loops confirmed", "segments joined"),
)
_DARK_S = 1.5
_REFERENCE = 30
"""Frames of a segment whose truth says where its world lies."""


@dataclass(kw_only=True)
class _Watched(KnownPlaces):
    """Counts loops that are confirmed."""

    confirmed: list[Loop] = field(default_factory=list[Loop])

    def compare(self, *args: object, **options: object) -> list[Loop]:
        found = super().compare(*args, **options)  # pyright: ignore[reportArgumentType]
        self.confirmed += found
        return found


@dataclass(frozen=True, kw_only=True)
class Run:
    """What came of one way after the dark.

    frames: after the dark.   found: those of them that have a pose in a segment of before.
    wrong: all frames with a wrong pose in those, as it was known then or at the end.   astray: in
    segments that began later.
    """

    frames: int
    found: int
    confirmed: int
    joined: int
    wrong: list[int]
    astray: list[int]


class _Session:
    """Frames one after the other, until they part."""

    def __init__(self, film: Film, config: Config, seed: int) -> None:
        self._film = film
        self.tracker = ExtremaTracker(CAMERA.width, CAMERA.height, config.tracking, seed)
        self.mapper = Mapper(CAMERA.pinhole(), config.bundle_adjustment, seed)
        self.mapper.atlas.places = _Watched()
        self.history, self.truth, self.joined = MapHistory(), dict[int, F64](), 0
        self._next = 0

    def part(self, film: Film) -> "_Session":
        """Another one that has seen the same, and goes on in a film."""
        other = copy(self)
        other._film = film
        other.tracker, other.mapper = deepcopy((self.tracker, self.mapper))
        other.history, other.truth = deepcopy((self.history, self.truth))
        return other

    def see(self, way: Way) -> None:
        """The camera goes along a way."""
        for grey, pose in self._film.along(way, self._next):
            self.truth[self._next] = pose
            self._take(grey)

    def be_in_the_dark(self) -> None:
        for _ in range(round(_DARK_S * CAMERA.fps)):
            self._take(np.zeros((CAMERA.height, CAMERA.width), np.uint8))

    def _take(self, grey: U8) -> None:
        frame, self._next = self._next, self._next + 1
        stamp_ns = round(frame * 1e9 / CAMERA.fps)
        tracks = self.tracker.track(grey, stamp_ns)
        delta = self.mapper.process(Frame(frame, stamp_ns, tracks, grey))
        self.mapper.publish_keyframes()
        self.history.apply(delta, frame=frame, stamp_ns=stamp_ns)
        self.joined += len(delta.joined)

    def end(self, night: int, apart_m: float) -> Run:
        """What came of it.   night: first frame in the dark."""
        delta = self.mapper.finish()
        self.history.apply(delta, frame=self._next, stamp_ns=0, final=True)
        final = self.history.final()
        before = {segment for frame, (segment, _) in final.items() if frame < night}
        after = [frame for frame in self.truth if frame > night]
        wrong = {
            each
            for poses in (self.history.online, final)
            for each in wrong_poses(poses, self.truth, apart_m)
        }
        assert isinstance(self.mapper.atlas.places, _Watched)
        return Run(
            frames=len(after),
            found=sum(frame in final and final[frame][0] in before for frame in after),
            confirmed=len(self.mapper.atlas.places.confirmed),
            joined=self.joined + len(delta.joined),
            wrong=sorted({frame for segment, frame in wrong if segment in before}),
            astray=sorted({frame for segment, frame in wrong if segment not in before}),
        )


def run(deceiver: Deceiver, config: Config, seed: int) -> Iterator[tuple[str, Run]]:
    """Map a deceiver, and come back to it from the dark by each of its ways."""
    film = Film(deceiver, seed)
    session = _Session(film, config, seed)
    session.see(deceiver.there)
    night = len(session.truth)
    session.be_in_the_dark()
    if deceiver.moved_m:
        film = Film(deceiver.after_the_dark(), seed)
    for name, way in deceiver.again.items():
        one = session.part(film)
        one.see(way)
        yield name, one.end(night, deceiver.apart_m)


def wrong_poses(
    poses: dict[int, tuple[int, F64]], truth: dict[int, F64], apart_m: float
) -> Iterator[tuple[int, int]]:
    """Segments and their frames that are elsewhere."""
    for segment in {segment for segment, _ in poses.values()}:
        frames = sorted(f for f, (of, _) in poses.items() if of == segment and f in truth)
        mine = pose_to_matrix(np.array([poses[frame][1] for frame in frames]))
        true = np.array([truth[frame] for frame in frames])
        first = slice(0, _REFERENCE)
        U, _, Vt = np.linalg.svd((true[first, :3, :3] @ mine[first, :3, :3].mT).sum(axis=0))
        R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
        a, b = mine[:, :3, 3] @ R.T, true[:, :3, 3]
        middle_a, middle_b = a[first].mean(axis=0), b[first].mean(axis=0)
        a, b = a - middle_a, b - middle_b
        scale = np.sqrt((b[first] ** 2).sum() / (a[first] ** 2).sum())
        errors = np.linalg.norm(scale * a - b, axis=1)
        far = [frame for frame, error in zip(frames, errors, strict=True) if error > apart_m]
        yield from ((segment, frame) for frame in far)


SCENES: dict[str, Callable[[int], Deceiver]] = {
    "two rooms alike but for a picture": partial(rooms, both=True),
    "two rooms, one of them mapped": partial(rooms, both=False),
    "the same door twenty times": partial(doors, bare=False),
    "the same door twenty times, on a bare wall": partial(doors, bare=True),
    "a chequered floor": floor,
    "a room whose picture hangs elsewhere": lambda seed: room_with(seed, "picture"),
    "a room with two of nine things elsewhere": lambda seed: room_with(seed, "thing 1", "poster 0"),
}


def measure(config: Config, seeds: int, only: str) -> Iterator[str]:
    """A row for each way back, of so many runs with another seed each."""
    yield markdown_header(_HEADER)
    for name, build in SCENES.items():
        if only not in name:
            continue
        came: dict[str, list[Run]] = {}
        for seed in range(seeds):
            for way, one in run(build(seed), config, seed):
                came.setdefault(way, []).append(one)
        for way, some in came.items():
            counts = [
                len(some),
                sum(one.frames for one in some),
                sum(one.found for one in some),
                sum(len(one.wrong) for one in some),
                sum(len(one.astray) for one in some),
                sum(one.confirmed for one in some),
                sum(one.joined for one in some),
            ]
            yield markdown_row((f"{name}: {way}", *map(str, counts)))
