"""Batches in parts: in order, parts of parts, in a forked child."""

from __future__ import annotations

import gc
import multiprocessing
import sys
import threading
import weakref
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numba
import pytest

from hhsr.batches import LEAST, in_parts
from hhsr.workers import hand_out


@pytest.fixture(autouse=True)
def two_threads() -> Iterator[None]:
    """Two threads, and afterwards as many as before."""
    before = numba.get_num_threads()
    numba.set_num_threads(min(2, numba.config.NUMBA_NUM_THREADS))
    yield
    numba.set_num_threads(before)


def rows(start: int, stop: int) -> list[int]:
    return list(range(start, stop))


def all_rows(count: int) -> list[int]:
    return [row for part in in_parts(count, 10, rows) for row in part]


def test_parts_come_in_order_and_hold_every_row_once() -> None:
    for count in (0, 1, 19, 20, 1003):
        assert all_rows(count) == rows(0, count)
    if numba.get_num_threads() > 1:
        sizes = [len(part) for part in in_parts(1003, 80, rows)]
        assert sizes[0] > 1003 // 5
        assert sizes == sorted(sizes, reverse=True)
        assert min(sizes[:-1]) == 80 // LEAST
    assert in_parts(19, 10, rows) == [rows(0, 19)]


def test_a_part_may_have_parts() -> None:
    found = in_parts(1000, 10, lambda start, stop: all_rows(stop - start))
    assert sum(len(part) for part in found) == 1000


def test_an_error_in_a_part_reaches_the_caller_and_the_next_batch_is_answered() -> None:
    def fail(start: int, stop: int) -> int:
        if start > 0:
            raise ValueError(f"rows {start} to {stop}")
        return stop

    if numba.get_num_threads() > 1:
        with pytest.raises(ValueError, match="rows"):
            in_parts(1000, 10, fail)
    assert all_rows(1000) == rows(0, 1000)


def test_the_caller_works_too() -> None:
    threads: set[int] = set()
    in_parts(1000, 10, lambda start, stop: threads.add(threading.get_ident()))
    assert threading.get_ident() in threads


def test_batches_of_several_callers_end() -> None:
    with ThreadPoolExecutor(3) as callers:
        found = list(callers.map(all_rows, [1000] * 12))
    assert found == [rows(0, 1000)] * 12


def test_a_batch_does_not_wait_for_workers_that_are_not_free() -> None:
    if numba.get_num_threads() < 2:
        pytest.skip("one thread has no workers")
    begun, go_on, ended = threading.Event(), threading.Event(), threading.Event()

    def hold() -> None:
        begun.set()
        go_on.wait(30)
        ended.set()

    assert all_rows(1000) == rows(0, 1000)
    held = hand_out(hold, numba.get_num_threads() - 1)
    assert begun.wait(30)
    try:
        assert all_rows(1000) == rows(0, 1000)
        assert not ended.is_set()  # the batch came first
    finally:
        go_on.set()
    assert [task.finish() for task in held] == [None] * len(held)


def test_a_worker_that_waits_keeps_no_arrays() -> None:
    class Rows(list[int]):
        """A list that can be referred to weakly."""

    held = Rows(rows(0, 1000))
    alive = weakref.ref(held)
    in_parts(1000, 10, lambda start, stop, held=held: held[start:stop])  # type: ignore[misc]
    del held
    for _ in range(100):  # a task that was taken back is dropped when a worker next looks
        gc.collect()
        if alive() is None:
            break
        threading.Event().wait(0.05)
    assert alive() is None


@pytest.mark.skipif(sys.platform != "linux", reason="forking is what Linux does")
def test_a_forked_child_has_threads_of_its_own() -> None:
    assert all_rows(1000) == rows(0, 1000)
    with multiprocessing.get_context("fork").Pool(1) as pool:
        assert pool.apply_async(all_rows, (1000,)).get(timeout=30) == rows(0, 1000)
