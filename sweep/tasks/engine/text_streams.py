"""Output to a terminal, a pipe or a log that may be full, closed or missing.

Messages must not end the computation: a stream that fails becomes silent.
"""

from __future__ import annotations

import io
import logging
import os
import queue
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

#: Descriptors of standard input, output and error.
STANDARD_DESCRIPTORS = (0, 1, 2)

#: Longest time that a flush waits for a reader that has stopped [s].
STOPPED_READER_WAIT_SECONDS = 0.3

#: Time without any text after which the writer thread ends [s].
WRITER_IDLE_SECONDS_MAX = 5.0

#: Largest number of texts that wait for a stopped reader; further ones are dropped.
WAITING_TEXTS_MAX = 1000

#: Loggers of Dask and of its parts, whose handlers write to standard error.
DASK_LOGGER_NAMES = ("distributed", "tornado", "bokeh")


class ForgivingStream(io.TextIOBase):
    """Text stream that passes text on to another one, and drops it silently after the first error.

    The other stream may be None.
    """

    def __init__(self, stream: Any) -> None:
        self._stream = stream
        self.failure: Exception | None = None  # error after which the stream is silent

    @property
    def encoding(self) -> str:  # type: ignore[override]
        """Encoding of the inner stream; `utf-8` if it has none."""
        return getattr(self._stream, "encoding", None) or "utf-8"

    def isatty(self) -> bool:
        """Return True if the inner stream is a terminal."""
        return is_terminal(self._stream)

    def fileno(self) -> int:
        """Return the file descriptor of the inner stream.

        UnsupportedOperation is raised if it has none.
        """
        try:
            return int(self._stream.fileno())
        except (AttributeError, OSError, ValueError, TypeError):
            raise io.UnsupportedOperation("fileno") from None

    def writable(self) -> bool:
        """Return True, as text can always be passed to `write`."""
        return True

    def write(self, text: str) -> int:
        """Write a text to the inner stream, or drop it after an error. Return the text's length."""
        if not isinstance(text, str):
            raise TypeError(f"a stream of text takes no {type(text).__name__}")
        if self._stream is None or self.failure is not None:
            return len(text)
        try:
            try:
                self._stream.write(text)
            except UnicodeEncodeError:
                encoded = text.encode(self.encoding, "backslashreplace")
                self._stream.write(encoded.decode(self.encoding))
        except BlockingIOError:  # the reader is late: the next text may pass
            pass
        except Exception as error:
            self._go_silent(error)
        return len(text)

    def flush(self) -> None:
        """Flush the inner stream; an error makes the stream silent."""
        if self._stream is None or self.failure is not None:
            return
        with suppress(BlockingIOError):
            try:
                self._stream.flush()
            except BlockingIOError:
                raise
            except Exception as error:
                self._go_silent(error)

    def finish_writing(self) -> None:
        """Flush the inner stream for the last time.

        After an error the stream is silent, so that Python's own flush at exit can't fail.
        """
        self.flush()
        try:
            if self._stream is not None:
                self._stream.flush()
        except Exception as error:
            self._go_silent(error)

    def _go_silent(self, error: Exception) -> None:
        """Make the stream drop all further text, and record the error."""
        self.failure = error
        with suppress(OSError, ValueError):
            if (descriptor := self.fileno()) in STANDARD_DESCRIPTORS:
                # Text in the stream's buffer would be written at exit, which fails as well.
                null_descriptor = os.open(os.devnull, os.O_WRONLY)
                os.dup2(null_descriptor, descriptor)
                os.close(null_descriptor)


class StallTolerantStream(ForgivingStream):
    """Text stream whose reader may stop for a while, as a terminal does after Ctrl-S.

    A thread writes to the descriptor of the inner stream. A flush waits for this thread for at most
    `STOPPED_READER_WAIT_SECONDS`. After such a timeout, flushes do not wait until the reader
    continues. If `WAITING_TEXTS_MAX` texts wait, further ones are dropped. If the inner stream has
    no descriptor, texts are written to it at once.
    """

    def __init__(self, stream: Any) -> None:
        super().__init__(stream)
        self._waiting_texts: queue.Queue[str] = queue.Queue(WAITING_TEXTS_MAX)
        self._is_reader_stopped = False
        self._writer_thread: threading.Thread | None = None
        self._handover_lock = threading.Lock()

    def write(self, text: str) -> int:
        """Queue a text for the writer thread, or drop it if too many wait. Return its length."""
        try:
            self.fileno()
        except io.UnsupportedOperation:
            return super().write(text)
        if not isinstance(text, str):
            raise TypeError(f"a stream of text takes no {type(text).__name__}")
        if self.failure is None:
            with self._handover_lock:
                with suppress(queue.Full):
                    self._waiting_texts.put_nowait(text)
                if self._writer_thread is None:
                    super().flush()  # earlier text in the buffer comes first
                    self._writer_thread = threading.Thread(
                        target=self._write_waiting_texts, daemon=True
                    )
                    self._writer_thread.start()
        return len(text)

    def flush(self) -> None:
        """Wait until all queued texts are written, for at most `STOPPED_READER_WAIT_SECONDS`.

        After such a timeout, flushes do not wait until the reader continues.
        """
        if self._writer_thread is None:
            super().flush()
            return
        deadline = time.monotonic() + (
            0.0 if self._is_reader_stopped else STOPPED_READER_WAIT_SECONDS
        )
        with self._waiting_texts.all_tasks_done:
            while (
                self._waiting_texts.unfinished_tasks
                and (seconds_left := deadline - time.monotonic()) > 0
            ):
                self._waiting_texts.all_tasks_done.wait(seconds_left)
            self._is_reader_stopped = self._waiting_texts.unfinished_tasks > 0

    def _write_waiting_texts(self) -> None:
        """Write the queued texts to the stream's descriptor as they arrive.

        Buffers of the stream are avoided, as the main thread needs their locks to exit. The thread
        ends if no text arrives for `WRITER_IDLE_SECONDS_MAX`.
        """
        while True:
            try:
                text = self._waiting_texts.get(timeout=WRITER_IDLE_SECONDS_MAX)
            except queue.Empty:
                with self._handover_lock:
                    if self._waiting_texts.empty():
                        self._writer_thread = None
                        return
                continue
            try:
                data = text.encode(self.encoding, "backslashreplace")
                while data and self.failure is None:
                    try:
                        data = data[os.write(self.fileno(), data) :]
                    except BlockingIOError:
                        time.sleep(STOPPED_READER_WAIT_SECONDS)
            except Exception as error:
                self._go_silent(error)
            finally:
                self._waiting_texts.task_done()


def make_dask_logs_stall_tolerant() -> None:
    """Replace the streams of Dask's log handlers, so that no message waits for a stopped terminal.

    Dask logs from its event loops. A loop that waits answers neither workers nor clients.
    """
    streams: dict[int, StallTolerantStream] = {}
    for name, logger in [*logging.root.manager.loggerDict.items()]:
        if name.partition(".")[0] not in DASK_LOGGER_NAMES or not isinstance(
            logger, logging.Logger
        ):
            continue
        for handler in logger.handlers:
            if not isinstance(handler, logging.StreamHandler):
                continue
            if isinstance(handler.stream, StallTolerantStream):
                continue
            try:
                descriptor = int(handler.stream.fileno())
            except (AttributeError, OSError, ValueError, TypeError):
                continue
            if descriptor in STANDARD_DESCRIPTORS:
                stream = streams.setdefault(descriptor, StallTolerantStream(handler.stream))
                # Not by setStream, which flushes the old stream first.
                handler.stream = stream


def is_terminal(stream: Any) -> bool:
    """Return True if a stream, which may be missing, closed or of any type, is a terminal."""
    try:
        return bool(stream.isatty())
    except Exception:
        return False


@contextmanager
def silence_failing_output() -> Iterator[None]:
    """Context manager in which standard output and error become silent after their first error."""
    _open_closed_descriptors()
    original_streams = sys.stdout, sys.stderr
    output, errors = (ForgivingStream(stream) for stream in original_streams)
    sys.stdout, sys.stderr = output, errors
    try:
        yield
    finally:
        output.finish_writing()
        if output.failure is not None and not isinstance(output.failure, BrokenPipeError):
            errors.write(f"standard output can't be written: {output.failure}\n")
        errors.finish_writing()
        sys.stdout, sys.stderr = original_streams


def _open_closed_descriptors() -> None:
    """Open the null device at each of the descriptors 0 to 2 that is closed.

    Otherwise files that are opened later would get these descriptors, and the program's output.
    """
    for descriptor in STANDARD_DESCRIPTORS:
        try:
            os.fstat(descriptor)
        except OSError:
            with suppress(OSError):
                os.open(os.devnull, os.O_RDWR)
