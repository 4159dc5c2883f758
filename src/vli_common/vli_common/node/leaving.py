"""The end of a process, in time whatever native code does.

The middleware may hang while it lets go of a node. rclpy calls it without releasing the interpreter, so that neither a thread of
Python's nor a handler of signals gets to run any more. A timer of the kernel does.
"""

from __future__ import annotations

import ctypes
import os

_CLOCK_MONOTONIC = 1
_SIGEV_THREAD = 2
_NANOSECONDS = 1_000_000_000


class _SignalEvent(ctypes.Structure):
    """``struct sigevent`` of sigevent(7), with the members of SIGEV_THREAD: 64 bytes."""

    _fields_ = (
        ("value", ctypes.c_void_p),
        ("signal", ctypes.c_int),
        ("notify", ctypes.c_int),
        ("function", ctypes.c_void_p),
        ("attributes", ctypes.c_void_p),
        ("reserved", ctypes.c_char * 32),
    )


class _TimerSpec(ctypes.Structure):
    """``struct itimerspec`` of timer_settime(2): period and time to the first expiry, seconds and nanoseconds each."""

    _fields_ = (
        ("period_s", ctypes.c_long),
        ("period_ns", ctypes.c_long),
        ("first_s", ctypes.c_long),
        ("first_ns", ctypes.c_long),
    )


def leave_after(seconds: float, code: int) -> None:
    """End this process with exit code ``code`` in so many seconds, unless it ends before; Python has no part in it.

    Call it when everything is saved: nothing is flushed, and no handler runs.

    Raises:
        OSError: the system has no timer left.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    function = ctypes.cast(libc._exit, ctypes.c_void_p).value
    event = _SignalEvent(value=code, notify=_SIGEV_THREAD, function=function)
    timer = ctypes.c_void_p()
    _check(libc.timer_create(_CLOCK_MONOTONIC, ctypes.byref(event), ctypes.byref(timer)))
    whole_s, fraction_s = divmod(seconds, 1.0)
    spec = _TimerSpec(first_s=int(whole_s), first_ns=max(1, int(fraction_s * _NANOSECONDS)))
    _check(libc.timer_settime(timer, 0, ctypes.byref(spec), None))


def _check(result: int) -> None:
    if result:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
