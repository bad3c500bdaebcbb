"""A limit on how long a block may take, kept by raising in its thread or by ending its worker."""

from __future__ import annotations

import ctypes
import os
import sys
import threading
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")

#: Seconds that a thread has, after its time, to come back from compiled code and be interrupted.
GRACE = 10.0


class Overtime(Exception):
    """A block took longer than it may."""


class _Interruption(BaseException):
    """Raised in a thread from outside; no `except Exception` on its way takes it for its own."""


class _Alarm:
    """Interrupts the thread that sets it, unless it is put off in time."""

    def __init__(self, seconds: float, *, deadly: bool) -> None:
        self._deadly, self._thread = deadly, threading.get_ident()
        self._guard = threading.RLock()  # its owner may be interrupted while taking it
        self._over = self.rung = False
        self._timer = _timer(seconds, self._ring)

    def set(self) -> None:
        """From here on the thread may be interrupted."""
        self._timer.start()

    def _ring(self) -> None:
        with self._guard:
            if self._over:
                return
            self.rung = True
            _raise_in(self._thread, _Interruption)
            if self._deadly:
                self._timer = _timer(GRACE, self._kill)
                self._timer.start()

    def _kill(self) -> None:
        with self._guard:
            if not self._over:
                os._exit(1)  # stuck in compiled code; a nanny starts another worker

    def put_off(self) -> None:
        """The work is over: from here on nothing is interrupted."""
        while not self._over:
            try:
                with self._guard:
                    _raise_in(self._thread, None)  # what was not delivered yet
                    self._over = True
            except _Interruption:
                continue
        self._timer.cancel()


def _timer(seconds: float, action: Callable[[], None]) -> threading.Timer:
    timer = threading.Timer(seconds, action)
    timer.daemon = True
    return timer


def _raise_in(thread: int, error: type[BaseException] | None) -> None:
    raised = ctypes.py_object(error) if error else None
    ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread), raised)


def limited(work: Callable[[], T], seconds: float | None, spent: float = 0.0) -> T:
    """Do some work, for no longer than some seconds less those spent before; None sets no limit.

    Python code is interrupted. A worker process that is still in compiled code `GRACE` seconds
    later ends itself; a process that computes on its own account waits for it to return.

    Raises
    ------
    Overtime
        Where it took longer.
    """
    if seconds is None:
        return work()
    alarm = _Alarm(max(seconds - spent, 0.0), deadly=_is_worker_process())
    where: _Interruption | None = None
    # No context manager: an interruption on the way into its exit would go past it.
    try:
        try:
            alarm.set()
            found = work()
        finally:
            alarm.put_off()
    except _Interruption as interruption:
        alarm.put_off()  # the only one there is may have come before that was begun
        where = interruption
    if alarm.rung:
        raise Overtime(f"took longer than the {seconds:g} s that a block may take") from where
    return found


def _is_worker_process() -> bool:
    """Whether this is a worker in a process of its own, which may end without harm."""
    return worker_address().partition("://")[0] not in ("", "inproc")


def worker_address() -> str:
    """Address of the Dask worker that this thread computes for; empty where there is none."""
    if "distributed" not in sys.modules:
        return ""
    from distributed import get_worker

    try:
        return str(get_worker().address)
    except ValueError:
        return ""
