"""Frames per second of each service, by the arrival of its reports."""

_WINDOW_NS = 1_000_000_000
"""A rate is the mean over at least so long."""


class Rates:
    """Holds one report of each service."""

    def __init__(self) -> None:
        self._since: dict[str, tuple[int, int]] = {}

    def take(self, service: str, frame: int, arrived_ns: int) -> float | None:
        """The rate since the last one given, about once a second; reports may be missing."""
        frame_then, then_ns = self._since.setdefault(service, (frame, arrived_ns))
        if arrived_ns - then_ns < _WINDOW_NS:
            return None
        self._since[service] = (frame, arrived_ns)
        return (frame - frame_then) * 1e9 / (arrived_ns - then_ns)
