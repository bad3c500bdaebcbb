"""Modules of sweep that `sweep run` enters, by package; `make size` prints it.

    python tests/modules_entered.py experiments/quickstart.yaml

A module counts where one of its functions is called from the command to the last committed chunk;
a module that is only imported does not.
"""

import sys
import tempfile
import threading
from collections import Counter
from pathlib import Path
from types import FrameType
from typing import Any

ROOT = Path(__file__).parents[1]
HOUSE = str(ROOT / "sweep") + "/"


def entered(spec: Path) -> set[str]:
    """Paths within sweep/ of the modules that a run of a spec enters."""
    from sweep.cli import main

    files: set[str] = set()

    def note(frame: FrameType, event: str, _: Any) -> None:
        # Class bodies and modules run as they are imported.
        if event == "call" and frame.f_code.co_flags & 0x2:  # CO_NEWLOCALS: a function's frame
            files.add(frame.f_code.co_filename)

    with tempfile.TemporaryDirectory() as folder:
        arguments = ["run", str(spec), "--store", f"{folder}/run.zarr", "--scheduler", "none"]
        threading.setprofile(note)
        sys.setprofile(note)
        try:
            main(arguments, standalone_mode=False)
        finally:
            sys.setprofile(None)
            threading.setprofile(None)
    return {name.removeprefix(HOUSE) for name in files if name.startswith(HOUSE)}


if __name__ == "__main__":
    for spec in sys.argv[1:]:
        found = sorted(entered(Path(spec)))
        outside = [name for name in found if not name.startswith("model/")]
        packages = Counter(name.split("/")[0] for name in outside)
        told = ", ".join(f"{package} {count}" for package, count in packages.items())
        print(f"{spec}: {len(outside)} modules outside the model ({told}), "
              f"{len(found) - len(outside)} in it")  # fmt: skip
        print("  " + " ".join(outside))
