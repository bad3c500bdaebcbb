"""Words to whoever runs a study: errors; a bar in a terminal, or plain lines."""

from __future__ import annotations

import logging
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO, TYPE_CHECKING, Any, cast

from sweep.messages import PrintableError, counted, printable
from sweep.plain_files import UnfitFileError
from sweep.storage.opening import StoreError as StoreError
from sweep.tasks.streams import PatientStream, is_terminal

if TYPE_CHECKING:
    from rich.progress import TaskID

#: Seconds between lines without a terminal.
LINE_EVERY = 30.0

#: Times a second that a bar is drawn, each some ms of the driver's time.
REFRESHES = 4.0

#: Columns of a terminal that has room for workers and bytes beside a bar.
BROAD = 100

#: Seconds before anything is shown of what is mostly over by then.
LATE = 2.0

_log = logging.getLogger("sweep")


class TaskError(PrintableError):
    """A study that can't be run as asked: the text says why and what to do."""


class BusyError(StoreError):
    """A store that another process writes to."""


class ClusterError(TaskError):
    """A scheduler or workers that can't be had."""


class CodeError(TaskError):
    """A function of the user's that may not run, can't be imported, or answers wrongly."""


class SchedulerLost(Exception):
    """A scheduler that went away with work still out; what was committed stays."""


@contextmanager
def told(what: str) -> Iterator[None]:
    """Say what can't be done where the disk, or an object store, raises."""
    try:
        yield
    except UnfitFileError as error:
        raise StoreError(f"{what}: {error}") from error
    except OSError as error:
        raise StoreError(f"{what}: {error.strerror or error}") from error


class Progress:
    """Listener to a run, told of how far it is; this one shows nothing."""

    def begin(self, *, points: int, done: float, unit: str) -> None:
        """Begin a run, with so many points of the study done already, some in part."""

    def advance(self, *, points: float, failed: int) -> None:
        """Points that were computed and blocks that were given up; both 0 as time passes."""

    def at_work(self, *, workers: int, stored: int) -> None:
        """Workers that there are, and bytes that are stored; told before `advance`."""

    def say(self, text: str) -> None:
        """Something to know, in words."""

    def end(self) -> None:
        """End the run."""


def chosen(progress: bool | Progress) -> Progress:
    """Return the progress asked for: none, the one given, or a display on standard error."""
    if progress is True:
        return Bar() if is_terminal(sys.stderr) else Lines()
    if progress is False:
        return Progress()
    return progress if isinstance(progress, _Guarded) else _Guarded(progress)


class _Guarded(Progress):
    """A listener of the user's, which is told nothing more once it has raised an error."""

    def __init__(self, listener: Progress) -> None:
        self._listener, self._has_failed = listener, False

    def _tell(self, method: str, *values: Any, **named: Any) -> None:
        if self._has_failed:
            return
        try:
            getattr(self._listener, method)(*values, **named)
        except Exception as error:
            self._has_failed = True
            _log.warning(
                "the listener to the progress failed in %s (%s: %s): the run goes on without it",
                method, type(error).__name__, error,
            )  # fmt: skip

    def begin(self, **facts: Any) -> None:
        self._tell("begin", **facts)

    def advance(self, **facts: Any) -> None:
        self._tell("advance", **facts)

    def at_work(self, **facts: Any) -> None:
        self._tell("at_work", **facts)

    def say(self, text: str) -> None:
        self._tell("say", text)

    def end(self) -> None:
        self._tell("end")


@contextmanager
def working(what: str, told: Progress | None = None) -> Iterator[None]:
    """Say from the third second on that something goes on, or that kernels are compiled."""
    from numba.core.event import install_recorder

    shown, begun, over = told or chosen(True), time.monotonic(), threading.Event()

    def text() -> str:
        done = sum(event.is_end for _, event in compiled.buffer)
        is_compiling = len(compiled.buffer) > 2 * done
        compiling = f"compiling the model, once; functions so far: {done}"
        return f"{compiling if is_compiling else what}, {duration(time.monotonic() - begun)}"

    def tell() -> None:
        pause = LATE
        while not over.wait(pause):
            if isinstance(shown, Bar):
                with shown.console.status(text()) as status:
                    while not over.wait(1 / REFRESHES):
                        status.update(text())
            else:
                shown.say(text())
                pause = min(2 * pause, LINE_EVERY)

    with install_recorder("numba:compile") as compiled:
        telling = threading.Thread(target=tell, daemon=True)
        telling.start()
        try:
            yield
        finally:
            over.set()
            telling.join()


class _Counting(Progress):
    """Progress that adds up what it is told."""

    def __init__(self) -> None:
        self._points = self._failed = 0
        self._done = self._before = 0.0
        self._unit, self._work = "points", ""
        self._begun = time.monotonic()

    def begin(self, *, points: int, done: float, unit: str) -> None:
        self._points, self._done, self._before, self._unit = points, done, done, unit
        self._begun = time.monotonic()
        self._show(begun=True)

    def advance(self, *, points: float, failed: int) -> None:
        self._done += points
        self._failed += failed
        self._show()

    def _show(self, *, begun: bool = False) -> None:
        """Show how far it is."""

    def at_work(self, *, workers: int, stored: int) -> None:
        from rich.filesize import decimal

        count = f"{workers:,} worker{'' if workers == 1 else 's'}"
        self._work = f"{count}, {decimal(stored)} stored"

    @property
    def _rate(self) -> float:
        """Points a second of this run."""
        return (self._done - self._before) / max(time.monotonic() - self._begun, 1e-9)

    @property
    def _words(self) -> dict[str, Any]:
        """All of it in words, by the names of a bar's columns."""
        return {
            "done": amount(self._done),
            "rate": f"{amount(self._rate)} {self._unit}/s" if self._rate > 0 else "",
            "work": self._work,
            "failures": f"{counted(self._failed, 'block')} failed" if self._failed else "",
        }


class Lines(_Counting):
    """One line at the start, every 30 s and at the end, for logs."""

    def __init__(self) -> None:
        super().__init__()
        self._said = time.monotonic()
        self._stream = PatientStream(sys.stderr)

    def _show(self, *, begun: bool = False) -> None:
        if begun or time.monotonic() - self._said >= LINE_EVERY:
            self.end()

    def say(self, text: str) -> None:
        """Print a line of its own."""
        print(printable(text), file=self._stream, flush=True)

    def end(self) -> None:
        """Say how far it is."""
        self._said = time.monotonic()
        done, rate, work, failures = self._words.values()
        left = (self._points - self._done) / self._rate if self._rate > 0 else 0.0
        parts = [f"{done} of {self._points:,} {self._unit}", rate]
        parts += [f"{duration(left)} left" if left > 0 else "", work, failures]
        self.say(", ".join(filter(None, parts)))


class Bar(_Counting):
    """A bar with points, rate, time left, workers, bytes and failures, on standard error."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
        from rich.table import Column

        super().__init__()
        self.console = Console(file=cast("IO[str]", PatientStream(sys.stderr)))

        def words(text: str) -> TextColumn:
            return TextColumn(text, table_column=Column())  # folded where others would be cut

        work = [words("{task.fields[work]}")] if self.console.width >= BROAD else []
        self._bar = Progress(
            BarColumn(bar_width=min(40, max(self.console.width - BROAD, 8))),
            words("{task.fields[done]} of {task.total:,.0f} {task.description}"),
            words("{task.fields[rate]}"),
            TimeRemainingColumn(compact=True),
            *work,
            words("[red]{task.fields[failures]}"),
            console=self.console,
            refresh_per_second=REFRESHES,
        )
        self._task: TaskID | None = None

    def _show(self, *, begun: bool = False) -> None:
        if begun:
            self._task = self._bar.add_task(
                self._unit, total=self._points, completed=int(self._done), **self._words
            )
            self._bar.start()
        if self._task is not None:
            self._bar.update(self._task, completed=self._done, **self._words)

    def say(self, text: str) -> None:
        """Print a line above the bar."""
        self.console.print(printable(text), markup=False, highlight=False, soft_wrap=True)

    def end(self) -> None:
        """Leave the bar as it is."""
        self._bar.stop()


def amount(points: float) -> str:
    """Points in words: `4,500`, or `0.31` where one is drawn in part; a low rate in two digits."""
    if points >= 10 or abs(points - round(points)) < 1e-6:
        return f"{points:,.0f}"
    return f"{points:.2g}"


def duration(seconds: float) -> str:
    """Put a time into words: `0.3 s`, `45 s`, `3 min 20 s`, `5 h 02 min`, `5,950 years`."""
    if seconds < 0.95:
        return f"{max(seconds, 0.0):.1g} s"
    whole = int(seconds + 0.5)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    if whole < 2 * 86400:
        return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
    days = seconds / 86400
    return f"{days:,.0f} days" if days < 2 * 365 else f"{days / 365.25:,.0f} years"
