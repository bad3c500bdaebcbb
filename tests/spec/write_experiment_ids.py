"""Writes the ids of the shipped experiments, which test_schema compares: `make ids`."""

import json
import sys
from pathlib import Path

from sweep.spec import SceneSpec, SpecError, load
from sweep.spec.fields import identity_digest

EXPERIMENTS = Path(__file__).parents[2] / "experiments"
IDS_FILE = Path(__file__).with_name("experiment_ids.json")


def experiment_ids(spec):
    """First digits of the id of a study, and of the geometry of each of its scanners.

    The version of the model is no part of these ids.
    """
    identities = [spec.identity()]
    if isinstance(spec, SceneSpec):
        identities += [spec.geometry_identity(scanner) for scanner in spec.scanners]
    return [identity_digest(identity | {"model": ""})[:8] for identity in identities]


def main():
    """Compute all ids anew. An experiment whose terrain is missing keeps its old ones."""
    ids = json.loads(IDS_FILE.read_text(encoding="utf-8"))
    for path in sorted(EXPERIMENTS.glob("*.yaml")):
        try:
            ids[path.stem] = experiment_ids(load(path))
        except SpecError as error:
            print(f"{path.stem} keeps its ids: {error}", file=sys.stderr)
    lines = [f"{json.dumps(name)}: {json.dumps(ids[name])}" for name in sorted(ids)]
    IDS_FILE.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")


if __name__ == "__main__":
    main()
