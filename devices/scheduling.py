"""Ask the operating system to run a thread before others: a polled tracker's frame stands for one period only."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import sys
import threading

__all__ = ["AS_ANY_OTHER", "HASTE", "Haste", "hurry_this_thread"]

#: what `hurry_this_thread` says where nothing was granted
AS_ANY_OTHER = "as any other thread"
_NICE = -10
#: how long another Python thread may compute before a waiting one gets its turn, s
_TURN_S = 0.0005
_WINDOWS_HIGHEST, _WINDOWS_ABOVE_NORMAL = 2, 1
_MAC_USER_INTERACTIVE = 0x21


def hurry_this_thread(real_time: bool = True) -> str:
    """Have the calling thread scheduled before ordinary ones, as far as this user may; return what was granted.

    Linux: the lowest real-time priority where the user may have one (``rtprio`` in ``limits.conf``, or root), else a
    nice value of -10 (``nice`` there). Windows and macOS: the highest class of ordinary threads. A thread that holds
    Python's lock while the system runs another process instead keeps all others of its process waiting, so threads that
    compute beside one that reads a tracker are best hurried too. (Short time slices, which Linux refuses nobody, were
    tried: on a machine with five busy processes for two cores 200 of 800 frames were lost with them, 22 without, none
    with either priority.)

    Parameters
    ----------
    real_time : bool
        False: no real-time priority; for threads that compute, beside the one that asks the device.

    Examples
    --------
    >>> said = []
    >>> thread = threading.Thread(target=lambda: said.append(hurry_this_thread()))
    >>> thread.start()
    >>> thread.join()
    >>> said[0] != ""
    True
    """
    if sys.platform == "linux":
        with contextlib.suppress(OSError):
            if real_time:
                lowest = os.sched_param(os.sched_get_priority_min(os.SCHED_RR))
                os.sched_setscheduler(0, os.SCHED_RR | os.SCHED_RESET_ON_FORK, lowest)
                return "real-time priority"
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)
            return f"nice {_NICE}"
    elif sys.platform == "win32":
        kernel = ctypes.windll.kernel32
        if kernel.SetThreadPriority(
            kernel.GetCurrentThread(), _WINDOWS_HIGHEST if real_time else _WINDOWS_ABOVE_NORMAL
        ):
            return "higher thread priority"
    elif sys.platform == "darwin" and not ctypes.CDLL(None).pthread_set_qos_class_self_np(_MAC_USER_INTERACTIVE, 0):
        return "user-interactive class"
    return AS_ANY_OTHER


class Haste:
    """Python kept from holding up the threads of this process, while anyone needs it; undone when nobody does.

    Python hands over between threads every 5 ms as a rule, and a question to a tracker takes three turns: a thread that
    computes in pure Python cost every third frame at 60 Hz, and none at 0.5 ms. A full garbage collection stops a
    process that has the whole of `guidance` loaded for 0.12 s, seven frames; frozen, what exists is not gone through
    (5 µs instead). Frames that are kept add to it, so it is frozen again now and then: `go_on`. What is frozen is
    not collected before the end; that matters to garbage in cycles only.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._users = 0
        self._usual_s = 0.0
        self._froze = False

    def begin(self) -> None:
        """Need it from now on."""
        with self._lock:
            self._users += 1
            if self._users > 1:
                return
            self._usual_s = sys.getswitchinterval()
            sys.setswitchinterval(min(_TURN_S, self._usual_s))
            self._froze = gc.get_freeze_count() == 0  # else someone froze on purpose, and will know when to undo it
            if self._froze:
                gc.freeze()

    def go_on(self) -> None:
        """Freeze what has come since; every few seconds."""
        with self._lock:
            if self._users and self._froze:
                gc.freeze()

    def end(self) -> None:
        """Need it no longer; once for each `begin`."""
        with self._lock:
            self._users -= 1
            if self._users > 0:
                return
            sys.setswitchinterval(self._usual_s)
            if self._froze:
                gc.unfreeze()


#: the one of this process
HASTE = Haste()
