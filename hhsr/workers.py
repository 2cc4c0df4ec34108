"""Threads that work on batches: started once and kept, for to start one takes as long as 5,000 points.

Not an executor's: its futures and conditions cost a batch as much as 3,000 points.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from queue import SimpleQueue
from threading import Lock, Thread, local
from typing import Any

_STARTING = Lock()
_THREAD = local()
_workers: list[Thread] = []
_queue: SimpleQueue[Task] = SimpleQueue()


class Task:
    """Work that waits for a worker; whoever handed it out takes it back where none has begun it meanwhile."""

    def __init__(self, work: Callable[[], Any]) -> None:
        self._work: Callable[[], Any] | None = work
        self._begun, self._done = Lock(), Lock()
        self._error: BaseException | None = None
        self._done.acquire()

    def run(self) -> None:
        """Do the work, unless it was taken back; keep what it raises."""
        if not self._begun.acquire(blocking=False):
            return
        try:
            if self._work is not None:
                self._work()
        except BaseException as error:  # raised where the work was handed out
            self._error = error
        finally:
            self._work = None  # a worker that waits keeps nobody's arrays
            self._done.release()

    def finish(self) -> BaseException | None:
        """Take the work back, or wait for its end; return what it raised."""
        if self._begun.acquire(blocking=False):
            self._work = None
            return None
        with self._done:
            return self._error


def hand_out(work: Callable[[], Any], times: int) -> list[Task]:
    """Hand the same work to so many workers, each of which begins it when it is free."""
    with _STARTING:
        while len(_workers) < times:
            _workers.append(Thread(target=_work_on, args=(_queue,), name=f"hhsr-{len(_workers)}", daemon=True))
            _workers[-1].start()
        tasks = [Task(work) for _ in range(times)]
        for task in tasks:
            _queue.put(task)
    return tasks


def is_working() -> bool:
    """Return whether this thread works on a batch."""
    return getattr(_THREAD, "working", False)


def set_working(working: bool) -> None:
    """Say whether this thread works on a batch."""
    _THREAD.working = working


def _work_on(queue: SimpleQueue[Task]) -> None:
    set_working(True)
    while True:
        queue.get().run()


def _forget() -> None:
    """Begin anew in a forked child, which has no threads but its own."""
    global _queue
    _queue = SimpleQueue()
    _workers.clear()
    _STARTING.release()


if hasattr(os, "register_at_fork"):  # not on Windows
    os.register_at_fork(before=_STARTING.acquire, after_in_parent=_STARTING.release, after_in_child=_forget)
