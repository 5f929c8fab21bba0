"""``pliant run --poses``: each pose as estimated at frame time, for other programs.

    pose FRAME SECONDS tx ty tz qx qy qz qw        T_world_camera
    pose FRAME SECONDS                             it has none, or none yet

The file trajectory_online.txt has the same poses in the end.  A slow reader delays nothing but the
end of the run, which waits until all are printed.
"""

import threading
from collections.abc import Generator
from contextlib import contextmanager, suppress
from queue import SimpleQueue

from pliant.algorithms.arrays import F64
from pliant.algorithms.geometry import matrix_to_pose
from pliant.bus.base import Received
from pliant.errors import MessageError
from pliant.formats.text import format_fixed, format_seconds
from pliant.map_history import MapHistory
from pliant.messages import codec, topics
from pliant.messages.types import MapUpdate, Surfels
from pliant.recording.map_file import MapFile
from pliant_services.runtime.launcher import Fleet

_LAST_S = 5.0
"""Maximum wait for the last poses after their service has ended, s."""
_LATE = 4
"""Messages that wait for an earlier one, which was lost on its way and is sent again."""


@contextmanager
def printed_poses(fleet: Fleet, known: MapFile | None, *, deformable: bool) -> Generator[None]:
    """Print them until the run is over.  known: the loaded map."""
    topic = topics.SURFELS if deformable else topics.MAP_UPDATE
    heard: SimpleQueue[Received | None] = SimpleQueue()
    history = MapHistory()
    for keyframe in known.keyframes() if known is not None else ():
        history.know(keyframe)

    def print_all() -> None:
        following, held = 0, dict[int, Received]()
        while (item := heard.get()) is not None and not item.is_end:
            if item.sequence >= following:  # not sent again
                held[item.sequence] = item
            while following in held or len(held) > _LATE:
                item = held.pop(min(held))
                following = item.sequence + 1
                print_one(item)
        for sequence in sorted(held):
            print_one(held[sequence])

    def print_one(item: Received) -> None:
        with suppress(MessageError):
            message = codec.decode(topic.message, item.data, max_bytes=topic.max_bytes)
            assert isinstance(message, MapUpdate | Surfels)
            print(_line(message, history), flush=True)

    def print_while_somebody_reads() -> None:
        with suppress(OSError):
            print_all()

    thread = threading.Thread(target=print_while_somebody_reads, daemon=True)
    thread.start()
    try:
        with fleet.listening(topic, heard.put):
            yield
            thread.join(_LAST_S)
    finally:
        heard.put(None)
        thread.join()


def _line(message: MapUpdate | Surfels, history: MapHistory) -> str:
    words = ["pose", str(message.frame), format_seconds(message.stamp_ns)]
    pose = _pose(message, history)
    return " ".join(words + ([] if pose is None else [format_fixed(value) for value in pose]))


def _pose(message: MapUpdate | Surfels, history: MapHistory) -> F64 | None:
    """(7,) where there is one."""
    if isinstance(message, Surfels):
        lost = message.missing or message.lost
        return None if lost else matrix_to_pose(message.T_world_camera)
    with suppress(KeyError):  # its keyframe was in an update that did not come
        history.apply(message, frame=message.frame, stamp_ns=message.stamp_ns)
    found = history.online.get(message.frame)
    return None if found is None else found[1]
