"""Which windows wait for the slow suite where a test needs the whole engine.

The engine is compiled anew, nearly a minute of it, for every number of terms that cosine sums
have. The fast suite has it for two and for five, the least and the most, and the tests of kernels
by themselves for all.
"""

import pytest

SLOW = ("blackman", "nuttall", "blackmanharris")
"""Three terms and four."""


def marked(windows):
    """Parameters of tests, of which those with slow windows are marked as such."""
    return [pytest.param(w, marks=pytest.mark.slow) if w in SLOW else w for w in windows]
