"""Buses that keep the state of a service after a frame, and go on from it."""

from pliant.bus.replay_bus import ReplayBus
from pliant.messages.topics import Topic
from pliant.messages.types import Header
from pliant.state import load_state, save_state

Messages = dict[Topic, list[Header]]


class Stopping(ReplayBus):
    """Keeps the state after a frame, as a service's checkpoint does."""

    def __init__(self, inputs: Messages, frame: int) -> None:
        super().__init__(inputs)
        self._frame = frame
        self.state = b""

    def checkpoint(self, frame: int, state: object) -> None:
        if frame == self._frame:
            self.state = save_state(state)


class Restarted(ReplayBus):
    """Goes on from such a state."""

    def __init__(self, inputs: Messages, state: bytes) -> None:
        super().__init__(inputs)
        self._state = state

    def restore(self) -> object:
        return load_state(self._state)
