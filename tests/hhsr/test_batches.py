"""Batches in parts: in order, parts of parts, in a forked child."""

from __future__ import annotations

import multiprocessing
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numba
import pytest

from hhsr.batches import LEAST, in_parts


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


@pytest.mark.skipif(sys.platform != "linux", reason="forking is what Linux does")
def test_a_forked_child_has_threads_of_its_own() -> None:
    assert all_rows(1000) == rows(0, 1000)
    with multiprocessing.get_context("fork").Pool(1) as pool:
        assert pool.apply_async(all_rows, (1000,)).get(timeout=30) == rows(0, 1000)
