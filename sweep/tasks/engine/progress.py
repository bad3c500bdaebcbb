"""Messages to the user of a run: errors, and progress as a bar in a terminal or as plain lines."""

from __future__ import annotations

import logging
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO, TYPE_CHECKING, Any, cast

from sweep.messages import EscapedMessageError, escape_unprintable, number_with_noun
from sweep.regular_files import RefusedFileError
from sweep.storage.store_format import StoreError as StoreError
from sweep.tasks.engine.text_streams import StallTolerantStream, is_terminal

if TYPE_CHECKING:
    from rich.progress import TaskID

#: Time between lines of progress without a terminal [s].
PROGRESS_LINE_INTERVAL_SECONDS = 30.0

#: Number of times per second that a progress bar is drawn [Hz]. Drawing takes some ms.
BAR_REFRESH_RATE_HZ = 4.0

#: Smallest width of a terminal [columns] at which a progress bar also shows workers and bytes.
WIDE_TERMINAL_COLUMNS_MIN = 100

#: Duration of an activity after which a message about it is shown [s]. Most activities are shorter.
ACTIVITY_MESSAGE_DELAY_SECONDS = 2.0

_log = logging.getLogger("sweep")


class RunRequestError(EscapedMessageError):
    """Error of a study that can't be run as requested. The message states reason and remedy."""


class StoreBusyError(StoreError):
    """Error of a store that another process writes to."""


class ClusterError(RunRequestError):
    """Error of a Dask scheduler or of workers that are not available."""


class CodeError(RunRequestError):
    """Error of a user's Python function: it is not allowed, can't be imported, or fails."""


class SchedulerLostError(Exception):
    """Error of a Dask scheduler that disappears during a run. Committed blocks are safe."""


@contextmanager
def raise_as_store_error(problem: str) -> Iterator[None]:
    """Context manager that raises any OSError of its body as a StoreError.

    The message of the StoreError begins with `problem`.
    """
    try:
        yield
    except RefusedFileError as error:
        raise StoreError(f"{problem}: {error}") from error
    except OSError as error:
        raise StoreError(f"{problem}: {error.strerror or error}") from error


class Progress:
    """Base of listeners to the progress of a run. Its methods do nothing."""

    def begin(self, *, points: int, done: float, unit: str) -> None:
        """Start to show a run of a study with `points` points.

        `done` is the number of points done before. A point that is computed in part counts as a
        fraction. `unit` is the noun for points, in the plural.
        """

    def advance(self, *, points: float, failed: int) -> None:
        """Report the numbers of points computed, and of blocks failed, since the last call.

        Both numbers are 0 in calls that only mark the passing of time.
        """

    def update_workers(self, *, workers: int, stored: int) -> None:
        """Report the number of workers and the size stored so far [bytes].

        The engine calls this method before `advance`.
        """

    def update_threads(self, *, threads: int, stored: int) -> None:
        """Report the number of computing threads and the size stored so far [bytes].

        If threads of this process compute, the engine calls this method before `advance` in place
        of `update_workers`. By default it calls `update_workers`.
        """
        self.update_workers(workers=threads, stored=stored)

    def say(self, text: str) -> None:
        """Show a message to the user."""

    def end(self) -> None:
        """Show that the run has ended."""


def make_progress(progress: bool | Progress) -> Progress:
    """Return a progress listener, given True, False or a listener of the user's.

    True stands for a display on standard error, and False for a silent listener. A listener of the
    user's is wrapped, so that its errors do not end the run.
    """
    if progress is True:
        return ProgressBar() if is_terminal(sys.stderr) else ProgressLines()
    if progress is False:
        return Progress()
    return progress if isinstance(progress, _GuardedListener) else _GuardedListener(progress)


class _GuardedListener(Progress):
    """Wrapper of a user's progress listener, which is not called after its first error."""

    def __init__(self, listener: Progress) -> None:
        self._listener, self._has_failed = listener, False

    def _call_listener(self, method: str, *values: Any, **keywords: Any) -> None:
        """Call a method of the listener, unless an earlier call has failed."""
        if self._has_failed:
            return
        try:
            getattr(self._listener, method)(*values, **keywords)
        except Exception as error:
            self._has_failed = True
            _log.warning(
                "the listener to the progress failed in %s (%s: %s): the run goes on without it",
                method, type(error).__name__, error,
            )  # fmt: skip

    def begin(self, **keywords: Any) -> None:
        self._call_listener("begin", **keywords)

    def advance(self, **keywords: Any) -> None:
        self._call_listener("advance", **keywords)

    def update_workers(self, **keywords: Any) -> None:
        self._call_listener("update_workers", **keywords)

    def update_threads(self, *, threads: int, stored: int) -> None:
        if hasattr(self._listener, "update_threads"):
            self._call_listener("update_threads", threads=threads, stored=stored)
        else:  # a user's own class that does not derive from `Progress`
            self._call_listener("update_workers", workers=threads, stored=stored)

    def say(self, text: str) -> None:
        self._call_listener("say", text)

    def end(self) -> None:
        self._call_listener("end")


@contextmanager
def show_activity(activity: str, progress: Progress | None = None) -> Iterator[None]:
    """Context manager that shows the text `activity` if its body takes more than two seconds.

    While kernels are compiled, the text says so instead.
    """
    from numba.core.event import install_recorder

    listener, start_time, is_over = (
        progress or make_progress(True),
        time.monotonic(),
        threading.Event(),
    )

    def activity_text() -> str:
        n_compiled = sum(event.is_end for _, event in compile_events.buffer)
        is_compiling = len(compile_events.buffer) > 2 * n_compiled
        compiling_text = f"compiling the model, once; functions so far: {n_compiled}"
        return (
            f"{compiling_text if is_compiling else activity}, "
            f"{duration_text(time.monotonic() - start_time)}"
        )

    def report() -> None:
        delay = ACTIVITY_MESSAGE_DELAY_SECONDS
        while not is_over.wait(delay):
            if isinstance(listener, ProgressBar):
                with listener.console.status(activity_text()) as status:
                    while not is_over.wait(1 / BAR_REFRESH_RATE_HZ):
                        status.update(activity_text())
            else:
                listener.say(activity_text())
                delay = min(2 * delay, PROGRESS_LINE_INTERVAL_SECONDS)

    with install_recorder("numba:compile") as compile_events:
        reporter_thread = threading.Thread(target=report, daemon=True)
        reporter_thread.start()
        try:
            yield
        finally:
            is_over.set()
            reporter_thread.join()


class _CountingProgress(Progress):
    """Base of progress listeners that add up computed points and failed blocks."""

    def __init__(self) -> None:
        self._n_points = self._n_failed = 0
        self._points_done = self._points_before = 0.0
        self._points_noun, self._workers_text = "points", ""
        self._start_time = time.monotonic()

    def begin(self, *, points: int, done: float, unit: str) -> None:
        self._n_points, self._points_done, self._points_before, self._points_noun = (
            points,
            done,
            done,
            unit,
        )
        self._start_time = time.monotonic()
        self._show_state(is_start=True)

    def advance(self, *, points: float, failed: int) -> None:
        self._points_done += points
        self._n_failed += failed
        self._show_state()

    def _show_state(self, *, is_start: bool = False) -> None:
        """Show the present numbers of points, threads or workers, bytes and failures."""

    def update_workers(self, *, workers: int, stored: int) -> None:
        self._set_workers_text(number_with_noun(workers, "worker"), stored)

    def update_threads(self, *, threads: int, stored: int) -> None:
        self._set_workers_text(number_with_noun(threads, "thread"), stored)

    def _set_workers_text(self, workers: str, stored: int) -> None:
        """Set the text that states workers and stored size, such as `3 workers, 1.2 MB stored`.

        `workers` is text with the number of workers or threads. `stored` is the size so far
        [bytes].
        """
        from rich.filesize import decimal

        self._workers_text = f"{workers}, {decimal(stored)} stored"

    @property
    def _points_per_second(self) -> float:
        """Number of points computed per second since this run began."""
        return (self._points_done - self._points_before) / max(
            time.monotonic() - self._start_time, 1e-9
        )

    @property
    def _column_texts(self) -> dict[str, Any]:
        """Texts that describe the present state, by the name of the progress bar's column."""
        return {
            "done": point_count_text(self._points_done),
            "rate": f"{point_count_text(self._points_per_second)} {self._points_noun}/s"
            if self._points_per_second > 0
            else "",
            "work": self._workers_text,
            "failures": f"{number_with_noun(self._n_failed, 'block')} failed"
            if self._n_failed
            else "",
        }


class ProgressLines(_CountingProgress):
    """Progress listener that prints one line at the start, every 30 s and at the end, for logs."""

    def __init__(self) -> None:
        super().__init__()
        self._printed_at = time.monotonic()
        self._stream = StallTolerantStream(sys.stderr)

    def _show_state(self, *, is_start: bool = False) -> None:
        if is_start or time.monotonic() - self._printed_at >= PROGRESS_LINE_INTERVAL_SECONDS:
            self.end()

    def say(self, text: str) -> None:
        """Print a message on a line."""
        print(escape_unprintable(text), file=self._stream, flush=True)

    def end(self) -> None:
        """Print a line with the present state of the run."""
        self._printed_at = time.monotonic()
        done_text, rate_text, workers_text, failures_text = self._column_texts.values()
        seconds_left = (
            (self._n_points - self._points_done) / self._points_per_second
            if self._points_per_second > 0
            else 0.0
        )
        parts = [f"{done_text} of {self._n_points:,} {self._points_noun}", rate_text]
        parts += [
            f"{duration_text(seconds_left)} left" if seconds_left > 0 else "",
            workers_text,
            failures_text,
        ]
        self.say(", ".join(filter(None, parts)))


class ProgressBar(_CountingProgress):
    """Progress bar on standard error with points, points per second, time left and failures."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
        from rich.table import Column

        super().__init__()
        self.console = Console(file=cast("IO[str]", StallTolerantStream(sys.stderr)))

        def text_column(text: str) -> TextColumn:
            return TextColumn(text, table_column=Column())  # wrapped, not truncated

        workers_column = (
            [text_column("{task.fields[work]}")]
            if self.console.width >= WIDE_TERMINAL_COLUMNS_MIN
            else []
        )
        self._bar = Progress(
            BarColumn(bar_width=min(40, max(self.console.width - WIDE_TERMINAL_COLUMNS_MIN, 8))),
            text_column("{task.fields[done]} of {task.total:,.0f} {task.description}"),
            text_column("{task.fields[rate]}"),
            TimeRemainingColumn(compact=True),
            *workers_column,
            text_column("[red]{task.fields[failures]}"),
            console=self.console,
            refresh_per_second=BAR_REFRESH_RATE_HZ,
        )
        self._task: TaskID | None = None

    def _show_state(self, *, is_start: bool = False) -> None:
        if is_start:
            self._task = self._bar.add_task(
                self._points_noun,
                total=self._n_points,
                completed=int(self._points_done),
                **self._column_texts,
            )
            self._bar.start()
        if self._task is not None:
            self._bar.update(self._task, completed=self._points_done, **self._column_texts)

    def say(self, text: str) -> None:
        """Print a message above the bar."""
        self.console.print(escape_unprintable(text), markup=False, highlight=False, soft_wrap=True)

    def end(self) -> None:
        """Stop drawing the bar, and leave it on the screen."""
        self._bar.stop()


def point_count_text(points: float) -> str:
    """Return a number of points as text: `4,500`, or two digits if below 10, as `0.31`.

    Numbers below 10 need not be whole: a point may be done in part, or the number may be per
    second.
    """
    if points >= 10 or abs(points - round(points)) < 1e-6:
        return f"{points:,.0f}"
    return f"{points:.2g}"


def duration_text(seconds: float) -> str:
    """Return a time as text: `0.3 s`, `45 s`, `3 min 20 s`, `5 h 02 min`, `5,950 years`."""
    if seconds < 0.95:
        return f"{max(seconds, 0.0):.1g} s"
    whole_seconds = int(seconds + 0.5)
    if whole_seconds < 60:
        return f"{whole_seconds} s"
    if whole_seconds < 3600:
        return f"{whole_seconds // 60} min {whole_seconds % 60:02d} s"
    if whole_seconds < 2 * 86400:
        return f"{whole_seconds // 3600} h {whole_seconds % 3600 // 60:02d} min"
    days = seconds / 86400
    return f"{days:,.0f} days" if days < 2 * 365 else f"{days / 365.25:,.0f} years"
