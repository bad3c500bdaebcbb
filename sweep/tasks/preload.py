"""Start of a local worker: leave Ctrl-C to the client, and import the model early."""

from __future__ import annotations

import signal
import threading
from typing import Any


def dask_setup(worker: Any) -> None:
    """Entry point that Dask calls in a starting worker."""
    # A terminal sends Ctrl-C to every process of the group; the workers have blocks to finish.
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    import sweep.model.shot  # noqa: F401
