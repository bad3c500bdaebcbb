"""A study of few blocks: each is many requests."""

from small_studies import small_spec

N_BLOCKS = 6


def six_block_spec(**changes):
    """The small study with 12 points in 6 blocks."""
    axes = {
        "instrument.laser.power": ["1 W", "3 W"],
        "target.range": {"linear": ["10 m", "5 km"], "number": 6},
    }
    return small_spec(**{"axes": axes, "storage": {"block_points": 2}, **changes})
