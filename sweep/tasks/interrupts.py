"""Handling of Ctrl-C and SIGTERM in a run: finish running blocks, or stop at once.

Python calls a signal handler only between two of its own instructions, but a call of compiled code
may take minutes, and batch systems kill 30 s after SIGTERM. A watcher thread therefore receives
each signal as it arrives and prints what happens. If the main thread does not handle a signal that
should stop it at once, the watcher ends the process, which stores survive as they survive any kill.
"""

from __future__ import annotations

import os
import selectors
import signal
import socket
import sys
import threading
import time
from contextlib import suppress
from types import FrameType
from typing import Any

from sweep.messages import INCOMPLETE, STORE, is_command, suggestion
from sweep.tasks.progress import Progress

#: Signals that end a run once its running blocks are done; the second one ends it at once.
SIGNALS = (signal.SIGINT, signal.SIGTERM)

#: Signal of a terminal that is closed, which comes several times; there is none on some systems.
HANGUP = getattr(signal, "SIGHUP", None)

#: Time that the main thread has to take a signal [s].
REACTION_SECONDS_MAX = 2.0

#: Time after SIGTERM that running blocks have to end [s]; batch systems mostly kill after 30 s.
TERMINATION_SECONDS_MAX = 15.0

#: Time between looks at whether it has taken one [s].
POLL_SECONDS = 0.1

#: Time that the last words of a process may take, as to a terminal that is stopped [s].
LAST_WORDS_SECONDS_MAX = 1.0

#: Bytes of signals that are read at once.
_SIGNALS_MAX = 4096

#: Byte that wakes the watcher, which is no signal.
_WAKE = b"\0"


class Interrupts:
    """Context manager for signals: the first lets running blocks finish, the second stops at once.

    It acts in the main thread only. A closed terminal (SIGHUP) counts as one Ctrl-C however often
    it is signalled, and not at all if the process ignores SIGHUP, as under nohup. SIGTERM counts as
    Ctrl-C with a deadline: blocks that run `TERMINATION_SECONDS_MAX` later are stopped, and if
    compiled code does not return within `REACTION_SECONDS_MAX` of SIGTERM, the process ends.

    Parameters
    ----------
    listener
        Progress listener for messages; called from the watcher thread.
    """

    def __init__(self, listener: Progress | None = None) -> None:
        self.stopping = False
        self.is_computing = False  # workers start or blocks run: stopped, only these are lost
        self._deadline: float | None = None  # time at which the process has to end
        self._listener = listener or Progress()
        self._before: dict[signal.Signals, Any] = {}
        self._announcing = threading.Lock()
        self._is_announced = False
        self._over = threading.Event()
        self._watcher: threading.Thread | None = None
        self._arrivals: socket.socket | None = None  # bytes of signals, until they are handled
        self._entrance: socket.socket | None = None  # where the system puts them

    def __enter__(self) -> Interrupts:
        if threading.current_thread() is threading.main_thread():
            self._watch_signals()
            numbers = list(SIGNALS)
            if HANGUP is not None and signal.getsignal(HANGUP) is not signal.SIG_IGN:
                numbers.append(HANGUP)
            self._before = {number: signal.signal(number, self._handle) for number in numbers}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
        if self._watcher is not None and self._arrivals and self._entrance:
            signal.set_wakeup_fd(-1)
            self._over.set()
            self._wake_watcher()
            self._watcher.join()
            self._arrivals.close()
            self._entrance.close()
            self._watcher = None

    def announce(self) -> None:
        """Print, once, that the run stops when running blocks are written."""
        with self._announcing:
            if not self._is_announced:
                self._is_announced = True
                self._listener.say("stopping when what runs is written; again to stop at once")

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self._arrivals is not None:
            with suppress(OSError):
                self._arrivals.recv(_SIGNALS_MAX)
        if self.stopping and number != HANGUP:
            raise KeyboardInterrupt
        self.stopping = True
        if number == signal.SIGTERM:
            self._deadline = time.monotonic() + TERMINATION_SECONDS_MAX
        self._wake_watcher()

    def _wake_watcher(self) -> None:
        if self._entrance is not None:
            with suppress(OSError):
                self._entrance.send(_WAKE)

    # The watcher

    def _watch_signals(self) -> None:
        """Start the watcher thread, unless an event loop of the caller already receives signals."""
        arrivals, entrance = socket.socketpair()
        arrivals.setblocking(False)
        entrance.setblocking(False)
        before = signal.set_wakeup_fd(entrance.fileno(), warn_on_full_buffer=False)
        if before != -1:  # an event loop of the caller's waits for signals there
            signal.set_wakeup_fd(before)
            arrivals.close()
            entrance.close()
            return
        self._arrivals, self._entrance = arrivals, entrance
        self._over.clear()
        self._watcher = threading.Thread(target=self._watch, args=(arrivals,), daemon=True)
        self._watcher.start()

    def _watch(self, arrivals: socket.socket) -> None:
        selector = selectors.DefaultSelector()  # which takes descriptors above 1023, too
        selector.register(arrivals, selectors.EVENT_READ)
        with selector:
            self._watch_arrivals(arrivals, selector)

    def _watch_arrivals(self, arrivals: socket.socket, selector: selectors.BaseSelector) -> None:
        while not self._over.is_set():
            selector.select(self._seconds_left())
            if self._seconds_left() == 0.0:
                self._deadline = None
                if self.is_computing:
                    os.kill(os.getpid(), signal.SIGTERM)
            n_answered = 0
            while numbers := self._untaken(arrivals):
                if len(numbers) > n_answered:
                    if self._is_taken(arrivals, len(numbers)):
                        continue
                    self._answer(numbers, is_repeated=n_answered > 0)
                    n_answered = len(numbers)
                elif self._over.wait(POLL_SECONDS):
                    return
            if self.stopping and not self._over.is_set():
                self.announce()

    def _seconds_left(self) -> float | None:
        """Return the time to the deadline [s]; None if there is none."""
        deadline = self._deadline
        return None if deadline is None else max(deadline - time.monotonic(), 0.0)

    def _untaken(self, arrivals: socket.socket) -> list[int]:
        """Return arrived signals that the main thread has not handled; discard wake-up bytes."""
        try:
            arrived = arrivals.recv(_SIGNALS_MAX, socket.MSG_PEEK)
            numbers = [number for number in arrived if number in self._before]
            if not numbers:
                arrivals.recv(len(arrived))
        except BlockingIOError:
            return []
        return numbers

    def _is_taken(self, arrivals: socket.socket, number: int) -> bool:
        """Wait up to `REACTION_SECONDS_MAX`; return whether a signal was handled meanwhile."""
        end = time.monotonic() + REACTION_SECONDS_MAX
        while time.monotonic() < end:
            if self._over.wait(POLL_SECONDS) or len(self._untaken(arrivals)) < number:
                return True
        return False

    def _answer(self, numbers: list[int], *, is_repeated: bool) -> None:
        """React to signals that compiled code holds up: print a message, or end the process."""
        if set(numbers) == {HANGUP}:
            return
        is_asked_again = self.stopping or is_repeated
        if signal.SIGTERM in numbers:
            self._leave(INCOMPLETE if is_command() else 128 + signal.SIGTERM)
        elif is_asked_again and is_command():
            self._leave(INCOMPLETE)
        elif is_asked_again:  # ending a program of the user's is not ours to do
            self._listener.say("compiled code runs: stopping as soon as it returns")
        else:
            self.announce()

    def _leave(self, code: int) -> None:
        """Print a last message and end the process from the watcher thread; never returns."""

        def speak() -> None:
            self._listener.end()
            self._listener.say(
                "stopped at once, while compiled code ran: what was committed stays, and "
                f"{suggestion('resume', STORE)} goes on"
            )
            for stream in (sys.stdout, sys.stderr):
                with suppress(Exception):
                    stream.flush()

        last_words = threading.Thread(target=speak, daemon=True)
        last_words.start()
        last_words.join(LAST_WORDS_SECONDS_MAX)
        os._exit(code)
