"""A program that uses the public names, as `make lint` checks it: nobody runs it."""

import sweep

spec = sweep.load("study.yaml")
outcome = sweep.run(spec, store="study.zarr", scheduler="none")
points: int = outcome.points
sweep.resume(outcome.store, progress=False)
maximum_range = sweep.open("study.zarr").sweep.maximum_range(pd=0.9)

# Mistakes that a checker tells; where it did not, it would say that nothing is to be ignored.
sweep.run(spec, stor="study.zarr")  # type: ignore[call-arg]
name: str = outcome.points  # type: ignore[assignment]
