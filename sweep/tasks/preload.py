"""Set-up of a starting worker: ignore the client's signals, protect output, import the model."""

from __future__ import annotations

import logging
import signal
import sys
import threading
from typing import Any

from distributed.comm import get_address_host

from sweep.tasks.engine.interrupts import HANGUP_SIGNAL
from sweep.tasks.engine.text_streams import StallTolerantStream, make_dask_logs_stall_tolerant


def dask_setup(worker: Any) -> None:
    """Set up a starting worker. Dask calls this function in the worker's process."""
    # A terminal sends Ctrl-C to all processes of its group, but workers finish their blocks.
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        # A closed terminal does the same with SIGHUP; a worker ends with its nanny.
        if HANGUP_SIGNAL is not None and getattr(worker, "nanny", None) is not None:
            signal.signal(HANGUP_SIGNAL, signal.SIG_IGN)
        make_dask_logs_stall_tolerant()
        # Printing in a user's function would otherwise fail its block if nobody reads the output,
        # and block it if a terminal has stopped.
        sys.stdout, sys.stderr = StallTolerantStream(sys.stdout), StallTolerantStream(sys.stderr)
        if get_address_host(worker.address) == get_address_host(worker.scheduler.address):
            # The driver compiles the same kernels, and says once that they can't be cached.
            logging.getLogger("sweep").setLevel(logging.ERROR)
    import sweep.model.evaluation  # noqa: F401
