"""Work in threads whose results come in order."""

from collections.abc import Iterator
from threading import Barrier, Event

import pytest

from pliant.fusion.parallel import in_order, processors


def test_results_come_in_the_order_of_the_items() -> None:
    second_is_done = Event()

    def work(item: int) -> int:
        if item == 0:
            assert second_is_done.wait(60)
        if item == 1:
            second_is_done.set()
        return item * item

    assert list(in_order(work, range(9), 2)) == [n * n for n in range(9)]


def test_workers_work_at_the_same_time() -> None:
    together = Barrier(3)
    assert sorted(in_order(lambda _: together.wait(60), range(3), 3)) == [0, 1, 2]


def test_few_items_are_taken_ahead() -> None:
    taken: list[int] = []

    def items() -> Iterator[int]:
        for n in range(100):
            taken.append(n)
            yield n

    results = in_order(lambda n: n, items(), 2)
    for n in range(10):
        assert next(results) == n
        assert len(taken) <= n + 4


def test_an_error_comes_where_its_result_would() -> None:
    results = in_order(lambda n: 1 // (2 - n), range(5), 2)
    assert [next(results), next(results)] == [0, 1]
    with pytest.raises(ZeroDivisionError):
        next(results)


def test_there_is_a_processor() -> None:
    assert 1 <= processors() <= 8
