"""Measure the CPU time of a shot by the number of its segments.

    python benchmarks/segment_timing.py [repeats]

A shot of the triangle ``up down`` is compared with two thirds of one of ``up doppler down``. Both
times are sums over segments, plus the work that is done once a shot. The smallest process CPU times
of alternating runs count.
"""

import sys
import time

import numpy as np

from sweep.model.effects.catalogue import DEFAULT_EFFECTS
from sweep.model.evaluation import evaluate
from sweep.model.waveform import SEGMENT_ORDER_PATH
from sweep.spec import load

SPEC = "experiments/single_shot_2000m.yaml"
N_POINTS = 2000


def main(repeats: int) -> None:
    """Print the times and their ratio."""
    ranges = np.linspace(100.0, 9000.0, N_POINTS)
    parameters = load(SPEC).parameters() | {"target.range": ranges, "target.grazing_angle": 1.0}
    seconds_by_order = dict.fromkeys(("up doppler down", "up down"), np.inf)
    for round_number in range(repeats + 1):
        for order in seconds_by_order:
            start = time.process_time()
            evaluate(parameters | {SEGMENT_ORDER_PATH: order}, DEFAULT_EFFECTS)
            if round_number:  # all is compiled
                seconds_by_order[order] = min(seconds_by_order[order], time.process_time() - start)
    three_segment_seconds, two_segment_seconds = seconds_by_order.values()
    for order, seconds in seconds_by_order.items():
        print(f"{order:16} {seconds / N_POINTS * 1e6:8.1f} us of CPU a shot")
    print(
        f"{two_segment_seconds / (three_segment_seconds * 2 / 3):.3f} of two thirds of the time of "
        "three segments"
    )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 10)
