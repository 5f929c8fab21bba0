"""A stopwatch that is passed in: algorithms name their stages, the caller owns the clock."""

from contextlib import AbstractContextManager, nullcontext
from typing import Protocol


class StageTimer(Protocol):
    """Called with the name of a stage; the context it returns spans that stage."""

    def __call__(self, stage: str) -> AbstractContextManager[object]: ...


def no_stages(stage: str) -> AbstractContextManager[object]:
    """Time nothing."""
    return nullcontext()
