"""Reports of stalled runs, in which no block is finished for long.

Workers of a cluster, threads of this process and the plain loop are watched in the same way.
"""

from __future__ import annotations

import logging
import textwrap
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

from sweep.messages import number_with_noun
from sweep.tasks.engine.progress import duration_text

#: Shortest time without any result after which a stall is reported [s].
STALL_REPORT_SECONDS = 60.0

#: Time without any result after which a stall is reported, as a multiple of a task's expected time,
#: if that is longer than `STALL_REPORT_SECONDS`.
STALL_TASK_DURATION_FACTOR = 5.0

#: Largest number of blocks in progress that a summary lists.
BLOCKS_IN_SUMMARY_MAX = 10

#: Time for which a run without any result may be loading or compiling the model [s].
COMPILATION_SECONDS_MAX = 600.0

#: Longest wait for the thread that watches the plain loop to end [s]; it may be printing.
WATCHER_JOIN_TIMEOUT_SECONDS = 1.0

MessagePrinter = Callable[[str], None]
"""Function that shows a message to the user."""

_log = logging.getLogger("sweep.stalls")


class StallMonitor:
    """Monitor that reports the state of a run if no result arrives for long.

    The intervals between reports increase. Every report logs the state, but only the first one
    after a result prints it. ``state_summary`` returns the state as text of several lines.
    """

    def __init__(self, say: MessagePrinter, state_summary: Callable[[], str]) -> None:
        self._say, self._state_summary = say, state_summary
        self._last_result_at = time.monotonic()
        self._patience = STALL_REPORT_SECONDS  # time after it until the next report [s]
        self._has_printed_state = False  # since the last result
        self._lock = threading.Lock()  # results and reports may come from different threads

    def record_result(self, expected_task_seconds: float) -> None:
        """Record that a result has arrived, and begin to wait for the next one.

        `expected_task_seconds` is the expected duration of a task [s].
        """
        with self._lock:
            self._last_result_at = time.monotonic()
            self._patience = max(
                STALL_REPORT_SECONDS, STALL_TASK_DURATION_FACTOR * expected_task_seconds
            )
            self._has_printed_state = False

    def restart_waiting(self) -> None:
        """Restart the count of the time without a result, as nothing is being computed."""
        with self._lock:
            self._last_result_at = time.monotonic()

    def report_if_stalled(self, *, explanation: str = "", explained_seconds: float = 0.0) -> None:
        """Print a message, and log the state of the run, if no result has arrived for a long time.

        In the first ``explained_seconds`` [s] after a result, the message states ``explanation``
        instead of the state.
        """
        with self._lock:
            seconds_waited = time.monotonic() - self._last_result_at
            if seconds_waited < self._patience:
                return
            is_explained = seconds_waited < explained_seconds
            self._patience = 2 * seconds_waited
            if is_explained:
                self._patience = min(self._patience, explained_seconds)
            shows_state = not is_explained and not self._has_printed_state
            self._has_printed_state |= shows_state
        summary = self._state_summary()
        _log.info("nothing came back for %s:\n%s", duration_text(seconds_waited), summary)
        stall_text = f"no block has come back for {duration_text(seconds_waited)}"
        if is_explained:
            self._say(f"{stall_text}: {explanation}")
        else:
            state_text = f":\n{textwrap.indent(summary, '  ')}" if shows_state else ""
            self._say(stall_text + state_text)


class BlockInProgress(NamedTuple):
    """Block that a thread of this process computes."""

    block: int
    """Number of the block in the study."""
    begun_at: float
    """Time at which its computation began [s since the epoch]."""
    thread_name: str
    """Name of the thread that computes it."""


class InProcessMonitor:
    """Monitor of the blocks that are computed in this process, by threads or by the plain loop.

    ``count_unassigned_blocks`` returns the number of blocks whose computation has not begun.
    """

    def __init__(self, say: MessagePrinter, count_unassigned_blocks: Callable[[], int]) -> None:
        self._count_unassigned_blocks = count_unassigned_blocks
        self._in_progress: dict[int, BlockInProgress] = {}  # by the identifier of the thread
        self._n_blocks, self._work_seconds = 0, 0.0
        self._stall_monitor = StallMonitor(say, self.state_summary)

    @contextmanager
    def mark_in_progress(self, block: int) -> Iterator[None]:
        """Context manager that lists a block as being computed by the calling thread."""
        thread = threading.current_thread()
        self._in_progress[threading.get_ident()] = BlockInProgress(block, time.time(), thread.name)
        try:
            yield
        finally:
            del self._in_progress[threading.get_ident()]

    def record_result(self, n_blocks: int, work_seconds: float) -> None:
        """Add the number and the computing time [s] of a result's blocks to the run's totals."""
        self._n_blocks += n_blocks
        self._work_seconds += work_seconds
        self._stall_monitor.record_result(self._work_seconds / max(self._n_blocks, 1))

    def report_if_stalled(self) -> None:
        """Print a message, and log the state of the run, if no result has arrived for long."""
        if self._in_progress:
            self._stall_monitor.report_if_stalled(
                explanation="the model is being loaded, or compiled once, which takes minutes "
                "where the machine is busy",
                explained_seconds=0.0 if self._n_blocks else COMPILATION_SECONDS_MAX,
            )
        else:
            self._stall_monitor.restart_waiting()

    def state_summary(self) -> str:
        """Return the state of the run as text: a line of counts, and a line for each thread."""
        now = time.time()
        in_progress = sorted(self._in_progress.values(), key=lambda entry: entry.begun_at)
        lines = [
            f"{number_with_noun(self._count_unassigned_blocks(), 'block')} not yet begun, "
            f"{number_with_noun(len(in_progress), 'block')} being computed; "
            f"{number_with_noun(self._n_blocks, 'block')} done in "
            f"{duration_text(self._work_seconds)} of work"
        ]
        lines += [
            f"block {entry.block}: computed by thread {entry.thread_name} since "
            f"{time.strftime('%H:%M:%S', time.localtime(entry.begun_at))}, "
            f"{duration_text(now - entry.begun_at)} ago"
            for entry in in_progress[:BLOCKS_IN_SUMMARY_MAX]
        ]
        return "\n".join(lines)

    @contextmanager
    def watch_in_thread(self, interval_seconds: float) -> Iterator[None]:
        """Context manager in which a thread checks for a stall every `interval_seconds` [s].

        Serial computation needs this thread, as its main thread is busy with a block.
        """
        is_over = threading.Event()

        def check() -> None:
            while not is_over.wait(interval_seconds):
                self.report_if_stalled()

        watcher = threading.Thread(target=check, name="stall-watcher", daemon=True)
        watcher.start()
        try:
            yield
        finally:
            is_over.set()
            watcher.join(WATCHER_JOIN_TIMEOUT_SECONDS)
