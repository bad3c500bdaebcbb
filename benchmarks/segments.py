"""CPU time of a shot by the number of its segments.

    python benchmarks/segments.py [repeats]

A shot of the triangle ``up down`` against two thirds of one of ``up doppler down``: both are sums
over their segments, with what is done once a shot on top. Least process CPU times of alternating
runs.
"""

import sys
import time

import numpy as np

from sweep.model.effects.catalogue import CORE
from sweep.model.shot import evaluate
from sweep.model.waveform import ORDER
from sweep.spec import load

SPEC = "experiments/single_shot_2000m.yaml"
POINTS = 2000


def main(repeats: int) -> None:
    """Print the times and their ratio."""
    far = np.linspace(100.0, 9000.0, POINTS)
    given = load(SPEC).parameters() | {"target.range": far, "target.grazing_angle": 1.0}
    least = dict.fromkeys(("up doppler down", "up down"), np.inf)
    for number in range(repeats + 1):
        for order in least:
            start = time.process_time()
            evaluate(given | {ORDER: order}, CORE)
            if number:  # all is compiled
                least[order] = min(least[order], time.process_time() - start)
    three, two = least.values()
    for order, seconds in least.items():
        print(f"{order:16} {seconds / POINTS * 1e6:8.1f} us of CPU a shot")
    print(f"{two / (three * 2 / 3):.3f} of two thirds of the time of three segments")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 10)
