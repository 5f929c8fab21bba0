"""Reading ahead changes when things are made, and nothing else."""

import sys
from collections.abc import Iterator
from functools import partial
from itertools import count, islice

import pytest

from pliant_services.replay.ahead import behind, quick_turns, read_ahead


def test_all_items_come_in_their_order() -> None:
    assert list(read_ahead(range(20))) == list(range(20))
    assert list(read_ahead([])) == []


def test_few_are_made_before_they_are_requested() -> None:
    made: list[int] = []

    def items() -> Iterator[int]:
        for number in count():
            made.append(number)
            yield number

    reader = read_ahead(items())
    assert list(islice(reader, 5)) == [0, 1, 2, 3, 4]
    reader.close()  # waits for what is on its way
    assert len(made) <= 5 + 4


def test_an_error_comes_behind_what_was_made_before_it() -> None:
    def items() -> Iterator[int]:
        yield 1
        yield 2
        raise ValueError("third")

    reader = read_ahead(items())
    assert [next(reader), next(reader)] == [1, 2]
    with pytest.raises(ValueError, match="third"):
        next(reader)


def test_jobs_are_done_in_their_order_and_all_of_them() -> None:
    done: list[int] = []
    with behind() as do:
        for number in range(20):
            do(partial(done.append, number))
    assert done == list(range(20))


def test_a_job_that_fails_is_heard_of() -> None:
    def fail() -> None:
        raise ValueError("the disk is full")

    with pytest.raises(ValueError, match="the disk is full"), behind() as do:
        do(fail)


def test_the_first_error_is_reported() -> None:
    def fail() -> None:
        raise ValueError("a later one")

    def both() -> None:
        with behind() as do:
            do(fail)
            raise KeyError("the first")

    with pytest.raises(KeyError, match="the first"):
        both()


def test_turns_are_as_before_when_all_is_done() -> None:
    usual = sys.getswitchinterval()
    with quick_turns():
        assert sys.getswitchinterval() < usual
    assert sys.getswitchinterval() == usual
