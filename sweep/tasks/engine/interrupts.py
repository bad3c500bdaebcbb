"""Handling of Ctrl-C and SIGTERM in a run: finish running blocks, or stop at once.

Python calls a signal handler only between two of its own instructions, but a call of compiled code
may take minutes, and batch systems kill 30 s after SIGTERM. A watcher thread therefore receives
each signal as it arrives and prints a message. If the main thread does not handle a signal that
should stop it at once, the watcher ends the process. Stores survive this as they survive any kill.
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

from sweep.messages import EXIT_INCOMPLETE, STORE_PLACEHOLDER, is_run_as_command, suggested_call
from sweep.tasks.engine.progress import Progress

#: Signals that end a run once its running blocks are written. A second such signal ends it at once.
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)

#: Signal of a closed terminal, which may arrive several times; None on systems without it.
HANGUP_SIGNAL = getattr(signal, "SIGHUP", None)

#: Time in which the main thread must handle a signal before the watcher thread reacts [s].
SIGNAL_HANDLING_SECONDS_MAX = 2.0

#: Time after SIGTERM in which running blocks must end [s]; batch systems mostly kill after 30 s.
SIGTERM_GRACE_SECONDS = 15.0

#: Interval at which the watcher thread checks whether a signal was handled [s].
SIGNAL_POLL_SECONDS = 0.1

#: Time limit for writing a process's last message, for example to a stopped terminal [s].
EXIT_MESSAGE_SECONDS_MAX = 1.0

#: Largest number of signals that are read at once from the socket, one byte each.
_SIGNALS_PER_READ_MAX = 4096

#: Byte that wakes the watcher thread and stands for no signal.
_WAKE_BYTE = b"\0"


class InterruptHandler:
    """Context manager for signals: the first lets running blocks finish, the second stops at once.

    It acts in the main thread only. A closed terminal (SIGHUP) counts as one Ctrl-C however often
    it is signalled, and not at all if the process ignores SIGHUP, as under nohup. SIGTERM counts as
    Ctrl-C with a deadline: blocks that run `SIGTERM_GRACE_SECONDS` later are stopped, and if
    compiled code does not return within `SIGNAL_HANDLING_SECONDS_MAX` of SIGTERM, the process ends.

    Parameters
    ----------
    listener
        Progress listener for messages; called from the watcher thread.
    """

    def __init__(self, listener: Progress | None = None) -> None:
        self.is_stopping = False
        self.is_computing = False  # True while workers start or blocks run
        self._deadline: float | None = None  # time at which the process must end
        self._listener = listener or Progress()
        self._previous_handlers: dict[signal.Signals, Any] = {}
        self._announce_lock = threading.Lock()
        self._is_announced = False
        self._is_over = threading.Event()
        self._watcher: threading.Thread | None = None
        self._wakeup_receiver: socket.socket | None = None  # receives the bytes of signals
        self._wakeup_sender: socket.socket | None = None  # the system sends the bytes here

    def __enter__(self) -> InterruptHandler:
        if threading.current_thread() is threading.main_thread():
            self._start_watcher()
            signals = list(STOP_SIGNALS)
            if HANGUP_SIGNAL is not None and signal.getsignal(HANGUP_SIGNAL) is not signal.SIG_IGN:
                signals.append(HANGUP_SIGNAL)
            self._previous_handlers = {
                signal_number: signal.signal(signal_number, self._handle_signal)
                for signal_number in signals
            }
        return self

    def __exit__(self, *_: object) -> None:
        for signal_number, handler in self._previous_handlers.items():
            signal.signal(signal_number, signal.SIG_DFL if handler is None else handler)
        if self._watcher is not None and self._wakeup_receiver and self._wakeup_sender:
            signal.set_wakeup_fd(-1)
            self._is_over.set()
            self._wake_watcher()
            self._watcher.join()
            self._wakeup_receiver.close()
            self._wakeup_sender.close()
            self._watcher = None

    def announce_stop(self) -> None:
        """Tell the listener that the run stops once its running blocks are written.

        Only the first call does so.
        """
        with self._announce_lock:
            if not self._is_announced:
                self._is_announced = True
                self._listener.say("stopping when what runs is written; again to stop at once")

    def _handle_signal(self, signal_number: int, frame: FrameType | None) -> None:
        if self._wakeup_receiver is not None:
            with suppress(OSError):
                self._wakeup_receiver.recv(_SIGNALS_PER_READ_MAX)
        if self.is_stopping and signal_number != HANGUP_SIGNAL:
            raise KeyboardInterrupt
        self.is_stopping = True
        if signal_number == signal.SIGTERM:
            self._deadline = time.monotonic() + SIGTERM_GRACE_SECONDS
        self._wake_watcher()

    def _wake_watcher(self) -> None:
        if self._wakeup_sender is not None:
            with suppress(OSError):
                self._wakeup_sender.send(_WAKE_BYTE)

    # Methods of the watcher thread

    def _start_watcher(self) -> None:
        """Start the watcher thread, unless an event loop of the caller already receives signals."""
        receiver, sender = socket.socketpair()
        receiver.setblocking(False)
        sender.setblocking(False)
        previous_descriptor = signal.set_wakeup_fd(sender.fileno(), warn_on_full_buffer=False)
        if previous_descriptor != -1:  # an event loop of the caller receives signals there
            signal.set_wakeup_fd(previous_descriptor)
            receiver.close()
            sender.close()
            return
        self._wakeup_receiver, self._wakeup_sender = receiver, sender
        self._is_over.clear()
        self._watcher = threading.Thread(target=self._run_watcher, args=(receiver,), daemon=True)
        self._watcher.start()

    def _run_watcher(self, receiver: socket.socket) -> None:
        selector = selectors.DefaultSelector()  # also accepts descriptors above 1023
        selector.register(receiver, selectors.EVENT_READ)
        with selector:
            self._watch_for_signals(receiver, selector)

    def _watch_for_signals(self, receiver: socket.socket, selector: selectors.BaseSelector) -> None:
        while not self._is_over.is_set():
            selector.select(self._seconds_to_deadline())
            if self._seconds_to_deadline() == 0.0:
                self._deadline = None
                if self.is_computing:
                    os.kill(os.getpid(), signal.SIGTERM)
            n_reported = 0
            while unhandled := self._unhandled_signals(receiver):
                if len(unhandled) > n_reported:
                    if self._wait_until_handled(receiver, len(unhandled)):
                        continue
                    self._react_to_stalled_signals(unhandled, is_repeated=n_reported > 0)
                    n_reported = len(unhandled)
                elif self._is_over.wait(SIGNAL_POLL_SECONDS):
                    return
            if self.is_stopping and not self._is_over.is_set():
                self.announce_stop()

    def _seconds_to_deadline(self) -> float | None:
        """Return the time until running blocks are stopped [s]; None without a deadline."""
        deadline = self._deadline
        return None if deadline is None else max(deadline - time.monotonic(), 0.0)

    def _unhandled_signals(self, receiver: socket.socket) -> list[int]:
        """Return the signal numbers of the signals that the main thread has not handled yet.

        Python sends one byte per signal to the socket `receiver`. The main thread removes the bytes
        when it handles a signal. This method removes bytes that only wake the watcher thread.
        """
        try:
            signal_bytes = receiver.recv(_SIGNALS_PER_READ_MAX, socket.MSG_PEEK)
            unhandled = [
                signal_number
                for signal_number in signal_bytes
                if signal_number in self._previous_handlers
            ]
            if not unhandled:
                receiver.recv(len(signal_bytes))
        except BlockingIOError:
            return []
        return unhandled

    def _wait_until_handled(self, receiver: socket.socket, n_signals: int) -> bool:
        """Wait for the main thread to handle a signal. Return False if the wait times out.

        The wait lasts at most `SIGNAL_HANDLING_SECONDS_MAX`. `receiver` is the socket that holds
        one byte per unhandled signal. `n_signals` is the number of unhandled signals when the wait
        begins.
        """
        deadline = time.monotonic() + SIGNAL_HANDLING_SECONDS_MAX
        while time.monotonic() < deadline:
            if (
                self._is_over.wait(SIGNAL_POLL_SECONDS)
                or len(self._unhandled_signals(receiver)) < n_signals
            ):
                return True
        return False

    def _react_to_stalled_signals(self, unhandled: list[int], *, is_repeated: bool) -> None:
        """React to signals that the main thread can't handle, as it runs compiled code.

        SIGTERM ends the process. A second signal ends the process of a `sweep` command, and prints
        a message in any other Python program. A first signal prints a message. The signal of a
        closed terminal has no effect. `unhandled` holds signal numbers. `is_repeated` is True if an
        earlier call has reacted to one of these signals.
        """
        if set(unhandled) == {HANGUP_SIGNAL}:
            return
        is_asked_again = self.is_stopping or is_repeated
        if signal.SIGTERM in unhandled:
            self._exit_process(EXIT_INCOMPLETE if is_run_as_command() else 128 + signal.SIGTERM)
        elif is_asked_again and is_run_as_command():
            self._exit_process(EXIT_INCOMPLETE)
        elif is_asked_again:  # a Python program of the user's is not ended
            self._listener.say("compiled code runs: stopping as soon as it returns")
        else:
            self.announce_stop()

    def _exit_process(self, exit_code: int) -> None:
        """Print a last message and end the process from the watcher thread. This never returns."""

        def print_last_words() -> None:
            self._listener.end()
            self._listener.say(
                "stopped at once, while compiled code ran: what was committed stays, and "
                f"{suggested_call('resume', STORE_PLACEHOLDER)} goes on"
            )
            for stream in (sys.stdout, sys.stderr):
                with suppress(Exception):
                    stream.flush()

        printer_thread = threading.Thread(target=print_last_words, daemon=True)
        printer_thread.start()
        printer_thread.join(EXIT_MESSAGE_SECONDS_MAX)
        os._exit(exit_code)
