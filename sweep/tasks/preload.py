"""Start of a worker: leave signals to the client, go on without output, import the model early."""

from __future__ import annotations

import logging
import signal
import sys
import threading
from typing import Any

from distributed.comm import get_address_host

from sweep.tasks.engine.interrupts import HANGUP_SIGNAL
from sweep.tasks.engine.text_streams import PatientStream, make_dask_logs_patient


def dask_setup(worker: Any) -> None:
    """Entry point that Dask calls in a starting worker."""
    # A terminal sends Ctrl-C to every process of the group; the workers have blocks to finish.
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        # The same of one that is closed; a worker ends with its nanny.
        if HANGUP_SIGNAL is not None and getattr(worker, "nanny", None) is not None:
            signal.signal(HANGUP_SIGNAL, signal.SIG_IGN)
        make_dask_logs_patient()
        # What a user's function prints would fail its block where nobody reads it any more, and
        # hold it up where a terminal has stopped.
        sys.stdout, sys.stderr = PatientStream(sys.stdout), PatientStream(sys.stderr)
        if get_address_host(worker.address) == get_address_host(worker.scheduler.address):
            # The driver compiles the same kernels, and says once that they can't be cached.
            logging.getLogger("sweep").setLevel(logging.ERROR)
    import sweep.model.evaluation  # noqa: F401
