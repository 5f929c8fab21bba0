"""Work on another core: reads inputs of a replay ahead, and writes its outputs behind."""

import sys
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Final, TypeVar

_Item = TypeVar("_Item")
_AHEAD = 3
_BEHIND = 32
_TURN_S = 5e-5
_END: Final = object()


def read_ahead(items: Iterable[_Item]) -> Generator[_Item]:
    """The same items in the same order; the next ones are made while one is looked at.

    Raises what ``items`` raises, in its place.
    """
    iterator = iter(items)

    def following() -> _Item | object:
        return next(iterator, _END)

    with ThreadPoolExecutor(1) as pool:
        waiting = deque(pool.submit(following) for _ in range(_AHEAD))
        while (item := waiting.popleft().result()) is not _END:
            waiting.append(pool.submit(following))
            yield item  # type: ignore[misc]


Do = Callable[[Callable[[], None]], None]


@contextmanager
def behind() -> Generator[Do]:
    """Gives what has jobs done in the order in which they are given, some of them later.

    It waits where others still wait, and raises what an earlier one raised; leaving, all are done.
    """
    waiting: deque[Future[None]] = deque()
    with ThreadPoolExecutor(1) as pool:

        def do(job: Callable[[], None]) -> None:
            waiting.append(pool.submit(job))
            while len(waiting) > _BEHIND:
                waiting.popleft().result()

        yield do
        for job in waiting:
            job.result()


@contextmanager
def quick_turns() -> Generator[None]:
    """Threads take turns a hundred times as often as usual.

    A thread that returns from a kernel, which runs without Python's lock, waits for the lock no
    longer than this; by default it would wait as long as the kernels of a frame take.
    """
    usual = sys.getswitchinterval()
    sys.setswitchinterval(_TURN_S)
    try:
        yield
    finally:
        sys.setswitchinterval(usual)
