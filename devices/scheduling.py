"""Ask the operating system to run a thread before others: a polled tracker's frame stands for one period only."""

from __future__ import annotations

import contextlib
import ctypes
import os
import sys
import threading

__all__ = ["AS_ANY_OTHER", "hurry_this_thread"]

#: what `hurry_this_thread` says where nothing was granted
AS_ANY_OTHER = "as any other thread"
_NICE = -10
_SLICE_NS = 500_000
#: number of the call sched_setattr on the machines where Linux runs in labs
_SET_ATTRIBUTES = {"x86_64": 314, "aarch64": 274}
_WINDOWS_HIGHEST = 2
_MAC_USER_INTERACTIVE = 0x21


def hurry_this_thread() -> str:
    """Have the calling thread scheduled before ordinary ones, as far as this user may; return what was granted.

    Linux: the lowest real-time priority where the user may have one (``rtprio`` in ``limits.conf``, or root), else a
    nice value of -10, else short time slices, which nobody is refused (kernel 6.12 on: a thread that asks for a short
    slice preempts one with a long slice as soon as it wakes). Windows and macOS: the highest class of ordinary threads.

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
        return _hurry_on_linux()
    if sys.platform == "win32":
        kernel = ctypes.windll.kernel32
        granted = kernel.SetThreadPriority(kernel.GetCurrentThread(), _WINDOWS_HIGHEST)
        return "highest thread priority" if granted else AS_ANY_OTHER
    if sys.platform == "darwin":
        refused = ctypes.CDLL(None).pthread_set_qos_class_self_np(_MAC_USER_INTERACTIVE, 0)
        return AS_ANY_OTHER if refused else "user-interactive class"
    return AS_ANY_OTHER


def _hurry_on_linux() -> str:
    assert sys.platform == "linux"
    # children of this thread are ordinary again
    policy = os.SCHED_RR | os.SCHED_RESET_ON_FORK
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, policy, os.sched_param(os.sched_get_priority_min(os.SCHED_RR)))
        return "real-time priority 1"
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)
        return f"nice {_NICE}"
    return f"time slices of {1e-6 * _SLICE_NS:g} ms" if _short_slices() else AS_ANY_OTHER


class _Attributes(ctypes.Structure):
    """``struct sched_attr`` of Linux, its first version."""

    _fields_ = (
        ("size", ctypes.c_uint32),
        ("policy", ctypes.c_uint32),
        ("flags", ctypes.c_uint64),
        ("nice", ctypes.c_int32),
        ("priority", ctypes.c_uint32),
        ("runtime", ctypes.c_uint64),
        ("deadline", ctypes.c_uint64),
        ("period", ctypes.c_uint64),
    )


def _short_slices() -> bool:
    assert sys.platform == "linux"
    number = _SET_ATTRIBUTES.get(os.uname().machine)
    if number is None or _kernel() < (6, 12):  # older ones take the call and ignore the slice
        return False
    nice = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())
    attributes = _Attributes(ctypes.sizeof(_Attributes), os.SCHED_OTHER, 0, nice, 0, _SLICE_NS)
    return bool(ctypes.CDLL(None).syscall(number, 0, ctypes.byref(attributes), 0) == 0)


def _kernel() -> tuple[int, ...]:
    first = os.uname().release.split("-")[0].split(".")[:2]
    return tuple(int(part) for part in first if part.isdigit())
