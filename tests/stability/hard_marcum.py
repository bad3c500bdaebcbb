"""Marcum's Q in both tails, and what a faint signal adds."""

import csv
from collections.abc import Iterable
from itertools import product
from pathlib import Path

import mpmath as mp
from hard_cases import EPS, Family

from sweep.model.detection.marcum import marcum_q1, marcum_q1_excess

FAMILY = Family(
    "Marcum Q",
    "Q1(a, b) and 1 - Q1; the error is the worst of the two, relative, of those that float64 can "
    "hold. Probabilities are exp(-d^2/2) times something smooth, "
    "d = |b - a|, so float64's limit is that of some operations of one rounding each, and "
    "no condition: a, b are taken as exact.",
)
ROUNDING_CASE = {
    "measure": "q, p",
    "allowed": 2e-15,
    "limit": EPS,
    "because": "exp and a product, rounded",
}
REFERENCE_TABLE = Path(__file__).parents[3] / "shared" / "reference" / "marcum_q1.csv"
SMALLEST_NORMAL = mp.mpf(2) ** -1022
INTEGRAL_REFERENCE = "Rice density integrated, 40 digits"

SignalAndThreshold = tuple[float, float]


def scaled_bessel(z: mp.mpf) -> mp.mpf:
    """exp(-z) I0(z): Bessel's function, and far out its asymptotic series."""
    if z < 80:
        return mp.exp(-z) * mp.besseli(0, z)
    term = total = mp.mpf(1)
    for k in range(1, 200):
        term *= (2 * k - 1) ** 2 / (8 * k * z)
        total += term
        if term < mp.eps * total:
            break
    return total / mp.sqrt(2 * mp.pi * z)


def log_tails_by_integration(a: mp.mpf, b: mp.mpf) -> tuple[mp.mpf, mp.mpf]:
    """(ln Q1, ln (1 - Q1)) by integrating the density over the tail away from a."""

    def ratio(r: mp.mpf) -> mp.mpf:
        decay = mp.exp(((b - a) ** 2 - (r - a) ** 2) / 2)
        return r / b * decay * scaled_bessel(a * r) / bessel_at_b

    bessel_at_b = scaled_bessel(a * b)
    log_at_b = mp.log(b) - (b - a) ** 2 / 2 + mp.log(bessel_at_b)
    steps = [mp.mpf(2) ** i / max(1, abs(b - a)) for i in range(-1, 8)]
    if b > a:
        edges = [b, *(b + step for step in steps)]
    else:
        edges = [0, *(b - step for step in reversed(steps) if step < b), b]
    log_tail = log_at_b + mp.log(mp.quad(ratio, edges, method="gauss-legendre"))
    other = mp.log1p(-mp.exp(log_tail))
    return (log_tail, other) if b > a else (other, log_tail)


def log_tails_on_diagonal(a: mp.mpf, b: mp.mpf) -> tuple[mp.mpf, mp.mpf]:
    """Of a = b: (1 + exp(-a^2) I0(a^2)) / 2, in closed form."""
    bessel = scaled_bessel(a * b)
    return mp.log1p(bessel) - mp.log(2), mp.log((1 - bessel) / 2)


def log_tails_of_noise(a: mp.mpf, b: mp.mpf) -> tuple[mp.mpf, mp.mpf]:
    """Of a = 0: exp(-b^2/2), in closed form."""
    return -(b**2) / 2, mp.log(-mp.expm1(-(b**2) / 2))


def worst_error(points: Iterable[SignalAndThreshold], exact_log_tails, digits: int = 40) -> float:
    """Worst relative error of both over the points."""
    largest = 0.0
    with mp.workdps(digits):
        for a, b in points:
            tails = marcum_q1(a, b)
            log_q, log_p = exact_log_tails(mp.mpf(a), mp.mpf(b))
            exact = mp.exp(log_q), mp.exp(log_p)
            for value, exact_value in zip(tails, exact, strict=True):
                if abs(exact_value) >= SMALLEST_NORMAL:
                    largest = max(largest, float(abs(mp.mpf(float(value)) / exact_value - 1)))
    return largest


@FAMILY.case("a = b from 1e-8 to 1e8", reference="closed form in I0, 60 digits", **ROUNDING_CASE)
def equal_arguments() -> float:
    # 1 - exp(-a^2) I0(a^2) is a^2 for small a: digits for 1e-16 and more.
    levels = [10.0**e for e in range(-8, 9)] + [0.3, 1.19, 1.21, 5.47, 5.48, 31.0]
    return worst_error([(x, x) for x in levels], log_tails_on_diagonal, 60)


@FAMILY.case(
    "no signal: thresholds from 1e-150 to 1e150",
    reference="closed form, 400 digits",
    **ROUNDING_CASE,
)
def no_signal() -> float:
    levels = [1e-150, 1e-100, 1e-20, 1e-8, 0.1, 1.0, 6.55, 20.0, 37.6, 1e3, 1e8, 1e150]
    return worst_error([(0.0, b) for b in levels], log_tails_of_noise, 400)


@FAMILY.case(
    "upper tail: 1e-300 and what lies about it", reference=INTEGRAL_REFERENCE, **ROUNDING_CASE
)
def upper_tail() -> float:
    return worst_error(
        [(a, a + d) for a in (0.5, 5.0, 100.0, 1e8) for d in (9.0, 37.5)], log_tails_by_integration
    )


@FAMILY.case(
    "lower tail: 1e-300 and what lies about it", reference=INTEGRAL_REFERENCE, **ROUNDING_CASE
)
def lower_tail() -> float:
    return worst_error(
        [(b + d, b) for b in (0.5, 5.0, 100.0, 1e8) for d in (9.0, 36.5)], log_tails_by_integration
    )


@FAMILY.case(
    "a, b = 1e8, a few deviations apart",
    is_slow=True,
    reference=INTEGRAL_REFERENCE,
    **ROUNDING_CASE,
)
def neighbouring_large_arguments() -> float:
    steps = (1.5e-8, 1e-3, 1.0, 3.0, 8.0)
    return worst_error(
        [p for d in steps for p in ((1e8, 1e8 + d), (1e8 + d, 1e8))], log_tails_by_integration, 60
    )


@FAMILY.case(
    "the seam between the two methods, ab = 30", reference=INTEGRAL_REFERENCE, **ROUNDING_CASE
)
def between_methods() -> float:
    below, above = 30.0 * (1 - 1e-12), 30.0 * (1 + 1e-12)
    return worst_error(
        [(ab / b, b) for ab in (below, above) for b in (0.5, 1.3, 5.4, 5.6, 20.0)],
        log_tails_by_integration,
    )


@FAMILY.case(
    "a threshold next to nothing: 1 - Q1 down to 1e-300",
    reference=INTEGRAL_REFERENCE,
    **ROUNDING_CASE,
)
def vanishing_threshold() -> float:
    return worst_error(
        [(a, b) for a in (1e-9, 0.7, 20.0) for b in (1e-150, 1e-60, 1e-9)],
        log_tails_by_integration,
        360,
    )


@FAMILY.case(
    "400 points of both tails",
    reference="table of 30 digits",
    reference_file=REFERENCE_TABLE,
    **ROUNDING_CASE,
)
def reference_table() -> float:
    exact = {}
    with REFERENCE_TABLE.open() as lines, mp.workdps(40):
        for row in csv.DictReader(lines):
            q, p = mp.mpf(row["Q"]), mp.mpf(row["one_minus_Q"])
            # The larger one's logarithm has the smaller one's digits.
            logs = (mp.log(q), mp.log1p(-q)) if q < p else (mp.log1p(-p), mp.log(p))
            exact[float(row["a"]), float(row["b"])] = logs
    return worst_error(exact, lambda a, b: exact[float(a), float(b)])


@FAMILY.case(
    "what signal of 1e-150 and more adds to the crossings of noise",
    reference="mixture of chi-square tails, 60 digits",
    measure="Q1(a, b) - Q1(0, b)",
    allowed=2e-15,
    limit=2 * EPS,
    because="exp(-b^2/2) and a sum, rounded",
)
def excess_over_noise() -> float:
    faint = (1e-150, 1e-20, 1e-8, 1e-3, 0.1, 0.5, 1.0, 1.9, 2.1, 8.0)
    points = list(product(faint, (0.1, 1.0, 4.0, 6.55, 14.0, 36.0)))
    # Either side of where the sum changes its length: ab at both ends of each length.
    length_changes = (0.322, 0.324, 1.67, 1.68, 2.8, 3.63, 3.64, 5.6, 7.99, 8.01)
    points += [(a, ab / a) for a in (0.14, 0.49, 0.7, 1.9) for ab in length_changes]
    largest = 0.0
    with mp.workdps(60):
        for a, b in points:
            exact_value = excess_by_poisson_mixture(mp.mpf(a), mp.mpf(b))
            if exact_value >= SMALLEST_NORMAL:
                value = mp.mpf(marcum_q1_excess(a, b))
                largest = max(largest, float(abs(value / exact_value - 1)))
    return largest


def excess_by_poisson_mixture(a: mp.mpf, b: mp.mpf) -> mp.mpf:
    """Q1(a, b) - Q1(0, b): a Poisson number n of chi-square tails, each less the first."""
    x, y = a**2 / 2, b**2 / 2
    weight, term, term_sum, total = mp.exp(-x), mp.exp(-y), mp.mpf(0), mp.mpf(0)
    for n in range(1, 2000):
        weight *= x / n
        term *= y / n
        term_sum += term
        total += weight * term_sum
        if n > x and weight < mp.eps * total:
            break
    return total
