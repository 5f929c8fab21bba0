"""Faults that a service skipped, logged at most once a second."""

from collections.abc import Mapping

from pliant.bus.inbox import Inbox
from pliant.bus.outbox import Outbox


class FaultLog:
    """Counts skipped messages, so that one line reports all of them."""

    def __init__(self, service: str) -> None:
        self._service = service
        self._reported: dict[str, tuple[int, ...]] = {}

    def line(self, inputs: Mapping[str, Inbox], outputs: Mapping[str, Outbox]) -> str:
        """A note on the messages skipped since the last call; "" for none."""
        parts: list[str] = []
        for key, box in inputs.items():
            new = self._new(key, (box.refused, box.repeated, box.early))
            words = zip(new, (f"refused ({box.why})", "repeated", "early"), strict=True)
            parts += [f"{key} {count} {word}" for count, word in words if count]
        for key, box in outputs.items():
            (new_credits,) = self._new(f"credit of {key}", (box.refused,))
            parts += [f"credit of {key} {new_credits} refused"] if new_credits else []
        return f"{self._service}: ignored messages: {', '.join(parts)}" if parts else ""

    def _new(self, key: str, counts: tuple[int, ...]) -> tuple[int, ...]:
        before = self._reported.get(key, (0,) * len(counts))
        self._reported[key] = counts
        return tuple(now - then for now, then in zip(counts, before, strict=True))
