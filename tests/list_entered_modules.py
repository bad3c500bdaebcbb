"""Modules of sweep that `sweep run` enters, by package; `make size` prints it.

    python tests/list_entered_modules.py experiments/quickstart.yaml

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
PACKAGE_PREFIX = str(ROOT / "sweep") + "/"


def entered_modules(spec: Path) -> set[str]:
    """Paths within sweep/ of the modules that a run of a spec enters."""
    from sweep.cli import main

    files: set[str] = set()

    def record_call(frame: FrameType, event: str, _: Any) -> None:
        # Class bodies and modules run as they are imported.
        if event == "call" and frame.f_code.co_flags & 0x2:  # CO_NEWLOCALS: a function's frame
            files.add(frame.f_code.co_filename)

    with tempfile.TemporaryDirectory() as folder:
        arguments = ["run", str(spec), "--store", f"{folder}/run.zarr", "--scheduler", "none"]
        threading.setprofile(record_call)
        sys.setprofile(record_call)
        try:
            main(arguments, standalone_mode=False)
        finally:
            sys.setprofile(None)
            threading.setprofile(None)
    return {name.removeprefix(PACKAGE_PREFIX) for name in files if name.startswith(PACKAGE_PREFIX)}


if __name__ == "__main__":
    for spec in sys.argv[1:]:
        module_names = sorted(entered_modules(Path(spec)))
        outside_model = [name for name in module_names if not name.startswith("model/")]
        packages = Counter(name.split("/")[0] for name in outside_model)
        packages_text = ", ".join(f"{package} {count}" for package, count in packages.items())
        print(f"{spec}: {len(outside_model)} modules outside the model ({packages_text}), "
              f"{len(module_names) - len(outside_model)} in it")  # fmt: skip
        print("  " + " ".join(outside_model))
