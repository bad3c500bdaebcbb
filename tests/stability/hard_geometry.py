"""Grazing and normal incidence, ranges over twelve decades, fast targets, optical phases."""

import math

import mpmath as mp
import numpy as np
from exact_spectrum import ExactLine
from hard_cases import EPS, Family
from shot_helpers import segment_lines
from table_4_1_shots import prepare_shot, table_4_1_parameters

from sweep.model import beamlets
from sweep.model.elementary_functions import (
    double_double_quotient,
    product_cycle_fraction,
    sincos_cycles,
)
from sweep.model.geometry import quaternion
from sweep.model.preparation import Shots

FAMILY = Family(
    "Geometry",
    "Footprints on a plane at any angle, and the place and phase of lines at any range and "
    "velocity. Ranges, angles and velocities are taken as exact: what their own rounding costs is "
    "float64's limit, and for phases it is by far the largest.",
)
WAVELENGTH = 1550e-9


def phase_of_range_rounding(range_m: float) -> float:
    """Optical phase [rad] of half a unit in the last place of a range."""
    return 4 * math.pi / WAVELENGTH * float(np.spacing(range_m)) / 2


# Footprints


def footprint_error(grazing: float, divergence: float) -> float:
    """Worst error of offset and cosine of 109 beamlets, over what their cancellations allow."""
    (beamlet_across, beamlet_along), _ = beamlets.place_beamlets(109)
    offset, cosine, weight, _ = beamlets.plane_footprint(
        grazing_angle=np.array([grazing]), beam_divergence=np.array([divergence]), n_beamlets=109
    )
    angle, sigma, worst = mp.mpf(grazing), mp.mpf(divergence) / 4, mp.mpf(0)
    for b in np.flatnonzero(weight[0] > 0):
        x, y = (mp.mpf(float(a[b])) * sigma for a in (beamlet_across, beamlet_along))
        length = mp.sqrt(1 + x * x + y * y)
        rise, fall = mp.sin(angle), y * mp.cos(angle)
        exact_offset = (length * rise - (rise + fall)) / (rise + fall)
        cosine_condition = (rise + abs(fall)) / (rise + fall)
        term_condition = (rise * (length - 1) + abs(fall)) / abs(rise * (length - 1) - fall)
        offset_error = abs(float(offset[0, b]) - exact_offset) / (
            abs(exact_offset) * (cosine_condition + term_condition)
        )
        cosine_error = abs(float(cosine[0, b]) / ((rise + fall) / length) - 1) / cosine_condition
        worst = max(worst, offset_error, cosine_error)
    return float(worst)


@FAMILY.case(
    "footprints from 0.01 deg to normal incidence, beams of 1 urad to 5 mrad",
    reference="rays on a plane, 90 digits",
    measure="offset, cosine of incidence, over the condition of their differences",
    allowed=1e-15,
    limit=3 * EPS,
    because="sine, cosine and beamlet's angle, rounded",
)
def footprints_at_all_angles() -> float:
    angles = [math.radians(a) for a in (0.01, 0.1, 1.0, 15.0, 45.0, 89.9999)] + [math.pi / 2]
    with mp.workdps(90):
        return max(footprint_error(a, d) for a in angles for d in (1e-6, 50e-6, 5e-3))


@FAMILY.case(
    "normal incidence, which float64 misses by 6e-17 rad, at 10 km",
    reference="a plane at 90 deg, 40 digits",
    measure="optical phase of a beamlet against the axis [rad]",
    allowed=1e-9,
    limit=4 * math.pi / WAVELENGTH * 1e4 * 5e-5 / 4 * 3 * 6.2e-17,
    because="pi/2, rounded, times the beam's angle",
)
def normal_incidence() -> float:
    (beamlet_across, beamlet_along), _ = beamlets.place_beamlets(109)
    offset, _, _, _ = beamlets.plane_footprint(
        grazing_angle=np.array([math.pi / 2]), beam_divergence=np.array([50e-6]), n_beamlets=109
    )
    with mp.workdps(40):
        sigma, worst = mp.mpf(50e-6) / 4, mp.mpf(0)
        for b in range(109):
            x, y = (mp.mpf(float(a[b])) * sigma for a in (beamlet_across, beamlet_along))
            exact_offset = mp.sqrt(1 + x * x + y * y) - 1
            worst = max(worst, abs(float(offset[0, b]) - exact_offset))
    return float(worst) * 1e4 * 4 * math.pi / WAVELENGTH


# Lines


def line_position_and_phase_errors(single_shot: Shots) -> tuple[float, float, float]:
    """Worst place [bins], the same over nu eps / 2, and worst phase [rad] of all lines."""
    position_error = relative_position_error = phase_difference = 0.0
    with mp.workdps(50):
        for segment in range(3):
            origin, delta, weight = segment_lines(single_shot, 0, segment)
            for b, value in enumerate(weight):
                line = ExactLine(single_shot, 0, segment, b)
                folded_bins = mp.nint(line.bins / single_shot.fft_size) * single_shot.fft_size
                folded, exact = line.bins - folded_bins, line.weight
                exact *= mp.expjpi(folded * single_shot.window.length / single_shot.fft_size)
                distance = abs(float(folded - origin - delta[b]))
                position_error = max(position_error, distance)
                relative_position_error = max(
                    relative_position_error, distance / (float(abs(line.bins)) * EPS / 2 + 1e-300)
                )
                phase_difference = max(
                    phase_difference, abs(float(mp.arg(mp.mpc(complex(value)) / exact)))
                )
    return position_error, relative_position_error, phase_difference


def shot_at_range(range_m: float) -> Shots:
    """A shot at a range, its chirp a few times as long as the echo's delay."""
    duration = max(500e-6, 2e-8 * range_m)
    return prepare_shot(range=range_m, duration=duration, fft_size=2**13, radial_velocity=-3.7)


def add_phase_cases() -> None:
    """A case for the phase at each range."""
    for range_m in (1e-3, 1.0, 2e3, 1e6, 1e9):
        delay, rate = 2 * range_m / 3e8, 1e9 / max(500e-6, 2e-8 * range_m)
        cycles, bins = rate * delay**2 / 2, (4.8e6 + rate * delay) * 2**13 / 600e6
        allowed = 2 * math.pi * (1.5 * cycles + bins / 2 + 4) * EPS
        FAMILY.case(
            f"the phase of a line at {range_m:g} m",
            reference="-f tau + S tau^2 / 2, 50 digits",
            measure="phase [rad]",
            allowed=allowed,
            limit=phase_of_range_rounding(range_m),
            because="the range, rounded",
        )(lambda range_m=range_m: line_position_and_phase_errors(shot_at_range(range_m))[2])


add_phase_cases()


@FAMILY.case(
    "the place of a line from 1 mm to 1e9 m",
    reference="f beta - S tau (1 + beta), 50 digits",
    measure="place, over the rounding of its distance from DC",
    allowed=8.0,
    limit=4.0,
    because="a sum of beats of opposite signs, each rounded",
)
def line_positions() -> float:
    return max(
        line_position_and_phase_errors(shot_at_range(r))[1]
        for r in (1e-3, 1.0, 123.456, 2e3, 1e6, 1e9)
    )


@FAMILY.case(
    "the place of a line at 10 km/s, folded 21 times",
    reference="f beta - S tau (1 + beta), 50 digits",
    measure="place [bins]",
    allowed=1e-10,
    limit=1.3e10 / 600e6 * 2**13 * EPS,
    because="a beat of 1.3e10 Hz, a product and a sum, rounded",
)
def fast_target() -> float:
    return max(
        line_position_and_phase_errors(prepare_shot(radial_velocity=v, range=r, fft_size=2**13))[0]
        for v in (1e4, -1e4, 9999.99999)
        for r in (1.0, 9e3)
    )


def optical_phase_error(*ranges_m: float) -> float:
    """Worst error of 2 R / lambda, R exact, in cycles."""
    high, low = double_double_quotient(2.0, WAVELENGTH)
    worst = 0.0
    with mp.workdps(60):
        for range_m in ranges_m:
            exact = 2 * mp.mpf(range_m) / mp.mpf(WAVELENGTH)
            difference = mp.mpf(product_cycle_fraction(high, low, range_m)) - exact
            worst = max(worst, float(abs(difference - mp.nint(difference))))
    return worst


@FAMILY.case(
    "optical phase at 1e6 m to 1e9 m, the range exact",
    reference="2 R / lambda, 60 digits",
    measure="cycles",
    allowed=2e-16,
    limit=phase_of_range_rounding(1e6) / (2 * math.pi),
    because="1e6 m, rounded; a plain product would lose as much again",
)
def far_phases() -> float:
    return optical_phase_error(1e6, 1234567.891, 9.87e6, 3.844e8, 999999999.9)


@FAMILY.case(
    "optical phase at 1e10 m to 1e12 m, the range exact",
    reference="2 R / lambda, 60 digits",
    measure="cycles",
    allowed=3e-14,
    limit=phase_of_range_rounding(1e10) / (2 * math.pi),
    because="1e10 m, rounded; the second double of 2 / lambda adds 100 cycles, rounded once",
)
def interplanetary_phases() -> float:
    return optical_phase_error(1e10, 1.496e11, 7.78e11, 999999999999.9)


@FAMILY.case(
    "sines of up to 1e8 cycles, about every eighth of one",
    reference="50 digits",
    measure="sine and cosine",
    allowed=4e-16,
    limit=EPS,
    because="a sum and a product near 1, rounded",
)
def sines_of_many_cycles() -> float:
    worst = 0.0
    with mp.workdps(50):
        for whole_cycles in (0.0, 1.0, -7.0, 1e4, -1e8):
            for cycle_fraction in (
                0.0,
                1e-300,
                1e-9,
                0.12499999,
                0.125,
                0.1250001,
                0.25,
                0.375,
                0.4999,
                0.5,
            ):
                x = whole_cycles + cycle_fraction
                sine, cosine = sincos_cycles(x)
                exact_phasor = mp.expjpi(2 * mp.mpf(x))
                worst = max(
                    worst,
                    float(abs(sine - exact_phasor.imag)),
                    float(abs(cosine - exact_phasor.real)),
                )
    return worst


@FAMILY.case(
    "echoes from 1 mm to 1e9 m: 24 decades of power",
    reference="P A tau rho / (2 pi R^2), 30 digits",
    measure="power",
    allowed=1e-15,
    limit=5 * EPS / 2,
    because="ten operations, rounded",
)
def echo_power() -> float:
    worst = 0.0
    shot_parameters = table_4_1_parameters()
    with mp.workdps(30):
        area = mp.pi * (mp.mpf(shot_parameters["instrument.telescope.aperture"]) / 2) ** 2
        for range_m in (1e-3, 0.7, 1234.5, 1e6, 1e9):
            exact = area * mp.mpf(0.1) / (2 * mp.pi * mp.mpf(range_m) ** 2)
            worst = max(worst, float(abs(prepare_shot(range=range_m).echo_power[0] / exact - 1)))
    return worst


# Turns


@FAMILY.case(
    "turns of 1e-300 rad to half a turn",
    reference="sin(angle / 2) along the axis, 40 digits; and the turn read back",
    measure="vector, of its length",
    allowed=8e-16,
    limit=2 * EPS,
    because="a length, a sine and a product, rounded",
)
def small_and_large_rotations() -> float:
    worst = mp.mpf(0)
    with mp.workdps(40):
        for angle in (1e-300, 1e-150, 1e-9, 1.99e-4, 2.01e-4, 1e-3, 1.0, 3.0, math.pi - 1e-9):
            vector = angle * np.array([0.36, 0.48, 0.8])
            exact_angle = mp.sqrt(mp.fsum(mp.mpf(float(x)) ** 2 for x in vector))
            rotation = quaternion.from_rotation_vector(vector)
            rotation_vector = quaternion.to_rotation_vector(rotation)
            for x, sine, component_back in zip(vector, rotation[1:], rotation_vector, strict=True):
                exact_sine = mp.mpf(float(x)) / exact_angle * mp.sin(exact_angle / 2)
                worst = max(worst, abs(float(sine) - exact_sine) / mp.sin(exact_angle / 2))
                worst = max(worst, abs(float(component_back) - mp.mpf(float(x))) / exact_angle)
    return float(worst)
