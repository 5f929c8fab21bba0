"""What ``pliant run --poses`` prints while messages are lost on their way, and sent again."""

from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import pytest
from map_updates import nothing

from pliant.bus.base import Received
from pliant.messages import codec
from pliant.messages.topics import Topic
from pliant.messages.types import MapUpdate
from pliant_services.run.poses import printed_poses


@dataclass
class Hears:
    """A fleet of which messages with these numbers are heard, and then the end."""

    numbers: Sequence[int]

    @contextmanager
    def listening(self, topic: Topic, on_message: Callable[[Received], None]) -> Generator[None]:
        for arrival, number in enumerate(self.numbers):
            header = {"frame": number, "stamp_ns": 10**9 * number, "frame_id": "world"}
            update = MapUpdate(**header, **vars(nothing()))  # type: ignore[arg-type]
            on_message(Received(topic, arrival, number, False, codec.encode(update)))
        on_message(Received(topic, len(self.numbers), 100, True, b""))
        yield


@pytest.mark.parametrize(
    ("heard", "printed"),
    [
        ([0, 1, 2], [0, 1, 2]),
        ([1, 2, 0, 1, 2, 3], [0, 1, 2, 3]),  # the first one is sent again
        ([0, 2], [0, 2]),  # it never came
        ([9, 8, 3, 4, 5, 6, 7, 2], [3, 4, 5, 6, 7, 8, 9]),  # too late: nothing waits for ever
    ],
)
def test_poses_are_in_order(
    heard: list[int], printed: list[int], capsys: pytest.CaptureFixture[str]
) -> None:
    with printed_poses(Hears(heard), None, deformable=False):  # type: ignore[arg-type]
        pass
    lines = capsys.readouterr().out.splitlines()
    assert [int(line.split()[1]) for line in lines] == printed
