"""Work for all processors whose results come in the order of the requests."""

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")
_MOST = 8


def processors() -> int:
    """Threads that are worth starting: kernels release the interpreter, and little else runs."""
    return min(os.cpu_count() or 1, _MOST)


def in_order(
    function: Callable[[_Item], _Result], items: Iterable[_Item], workers: int
) -> Iterator[_Result]:
    """``function`` of each item, in their order, computed in threads.

    Items are taken from the caller's thread; no more than two for each worker are under way or done
    and not yet taken, so that memory does not grow with their number.
    """
    with ThreadPoolExecutor(workers) as pool:
        waiting: deque[Future[_Result]] = deque()
        try:
            for item in items:
                waiting.append(pool.submit(function, item))
                if len(waiting) == 2 * workers:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()
