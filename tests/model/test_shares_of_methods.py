"""Random shots in developed speckle: closed forms and all ways to draw find the same shares.

Closed forms of grids, and draws of grids and of flights by probabilities, noise in bins and whole
spectra, are compared with drawn records of scatterers, for random instruments: real and I/Q
records, waveforms with and without a Doppler segment, several looks, all rules of detection, beats
near DC, slopes of 5 to 90 degrees.
"""

import math

import numpy as np
import pytest
import validate_speckle
from scatterer_shots import (
    COMPARED_EFFECTS,
    draw_shots,
    point_facet,
    segment_detections,
    shot_detections,
)
from scatterers import SPEED_OF_LIGHT
from shot_helpers import make_point_keys, parametrize_product
from test_drawn_speckle import flown
from validate_speckle import random_mapping, spec_of_ratio, stated_error

from sweep.model.pointcloud.pairing import FLAG_BITS, UNCONFIRMED_FLAG
from sweep.model.sampling.samplers import simulate_draws
from sweep.model.unsupported_shot import UnsupportedShotError
from sweep.spec import SpecError

SCATTERER_DRAWS, DRAWS, SPECTRA = 16_000, 5_000, 800
SLACK = 0.012
"""Error of draws beyond five standard deviations; that of the closed forms is their stated one."""
SIGMAS = 5.0
WIDE = 0.25
"""Deviation of lines [bins of fs/L] from which speckle differs over the bins of an echo."""


def spread_of(mapping):
    """Deviation of the lines of a chirp over the footprint [bins of fs/L], without motion."""
    laser, chirp, processing = (mapping["instrument"][k] for k in ("laser", "chirp", "processing"))
    target = mapping["target"]
    waist, distance = laser["beam_waist"], target["range"]
    rayleigh = np.pi * waist**2 / laser["wavelength"]
    deviation = waist * np.hypot(1, distance / rayleigh) / np.sqrt(8)
    delay = 2 * deviation / np.tan(target["grazing_angle"]) / SPEED_OF_LIGHT
    # Records of such specs last from the acquisition delay to the end of the chirp, or nearly.
    record = chirp["duration"] - processing["acquisition_delay"]
    return chirp["bandwidth"] / chirp["duration"] * delay * record


def spec_at_random(number):
    """A spec of a steep enough slope, a short record and a threshold that noise does not cross."""
    rng = np.random.default_rng([50, number])
    # Kinds take turns, so that few numbers have all of them.
    kind = ("looks", "any_bin", "peak_bin", "wide")[number % 4]
    steepest = 12 if kind == "wide" else 90
    while True:
        mapping = random_mapping(rng)
        ratio = float(np.exp(rng.uniform(np.log(0.8), np.log(4.0))))
        degrees = float(np.exp(rng.uniform(np.log(5), np.log(steepest))))
        instrument = mapping["instrument"]
        mapping["target"]["grazing_angle"] = math.radians(degrees if number % 8 else 90.0)
        mapping["target"]["reflectance_law"] = "thesis"
        processing = instrument["processing"]
        processing["tnr"] = float(rng.uniform(9, 12))
        several = "looks" in instrument
        if number % 6 == 5 and not several:
            processing["peaks"] = "strongest"
        if processing["fft_size"] > 2048 or (several and instrument["looks"]["number"] > 4):
            continue
        if several is not (kind == "looks"):
            continue
        if not several:
            processing["detection"] = "peak_bin" if kind == "peak_bin" else "any_bin"
        if kind == "wide" and spread_of(mapping) < WIDE:
            continue
        if number % 5 == 0 and "doppler" in instrument["chirp"]["segments"]:
            continue
        try:
            random_spec = spec_of_ratio(mapping, ratio)
        except (SpecError, UnsupportedShotError):
            continue
        chirps = [random_spec.stored_pd["pd_up"], random_spec.stored_pd["pd_down"]]
        if min(chirps) > 0.1 and max(chirps) < 0.97:
            return random_spec


def shares_of_grid(p, method, draws, seed):
    """Shares of a grid's draws by segment, and of the shot."""
    parameters = dict(p) | {"target.range": np.ravel(p["target.range"])[:1]}
    counts = simulate_draws(
        parameters,
        COMPARED_EFFECTS,
        keys=make_point_keys(1, seed),
        batch_sizes=[draws],
        method=method,
    )
    names = ("up", "doppler", "down", "shot")
    return {name: counts[f"n_detected_{name}"][0, 0] / draws for name in names}


def shares_of_flight(p, method, draws):
    """Shares of draws with a point, with a confirmed one, and with each flag."""
    place = {"instrument.processing.estimator.kind": "candan"} if method == "spectra" else {}
    flags = flown(dict(p) | place, method, draws)["flags"][0, :, 0]
    confirmed = (flags > 0) & (flags & UNCONFIRMED_FLAG == 0)
    shares = {"chirps": (flags > 0).mean(), "all segments": confirmed.mean()}
    return shares | {name: (flags & bit > 0).mean() for name, bit in FLAG_BITS.items()}


def compared(number):
    """Shares that differ from those of scatterers, or among flights, by more than is allowed."""
    random_spec = spec_at_random(number)
    shots, p, differing = random_spec.shots, random_spec.parameters, []
    detected = segment_detections(draw_shots(p, shots, draws=SCATTERER_DRAWS, seed=number), shots)
    chirps = detected["up"] & detected["down"]
    events = detected | {"shot": shot_detections(detected, shots), "chirps": chirps}
    if "doppler" in detected:
        events["all segments"] = chirps & detected["doppler"]
    truth = {name: float(event.mean()) for name, event in events.items()}
    facet = point_facet(p, shots)

    def compare(source, shares, draws, slack):
        for name, share in shares.items():
            if name not in truth or np.isnan(share):
                continue
            likely = np.clip(truth[name], 1e-3, 1 - 1e-3)
            sigma = math.sqrt(likely * (1 - likely) * (1 / draws + 1 / SCATTERER_DRAWS))
            allowed, difference = SIGMAS * sigma + slack[name != "doppler"], share - truth[name]
            if abs(difference) > allowed:
                differing.append(f"{source} {name}: {share:.4f} for {truth[name]:.4f}")

    law = [stated_error(name, shots, facet) + validate_speckle.TOLERANCE for name in ("up", "shot")]
    stored = {name[3:]: share for name, share in random_spec.stored_pd.items()}
    compare("closed form", {k: v for k, v in stored.items() if k != "shot"}, 1e9, law[:1] * 2)
    compare("closed form", {"shot": stored["shot"]}, 1e9, law)
    several, flights = shots.looks.is_noncoherent, {}
    for method, draws in (("probabilities", DRAWS), ("noise", DRAWS), ("spectra", SPECTRA)):
        if method == "noise" and several:  # refused
            continue
        if method == "spectra" and several:
            draws = 200
        slack = [max(SLACK, law[1]) if method == "probabilities" else SLACK] * 2
        compare(f"grid by {method}", shares_of_grid(p, method, draws, number), draws, slack)
        flights[method] = shares_of_flight(p, method, draws)
        compare(f"flight by {method}", flights[method], draws, slack)
    one = flights["probabilities"]
    for method, shares in flights.items():
        draws = DRAWS if method == "noise" else 200 if several else SPECTRA
        for name in FLAG_BITS:
            likely = np.clip(one[name], 1e-3, 1 - 1e-3)
            sigma = math.sqrt(likely * (1 - likely) * (1 / draws + 1 / DRAWS))
            if abs(shares[name] - one[name]) > SIGMAS * sigma + 0.02:
                differing.append(f"{method} {name}: {shares[name]:.4f} for {one[name]:.4f}")
    return differing


@pytest.mark.parametrize("number", parametrize_product(3, range(60)))
def test_all_methods_find_the_same_shares(number):
    assert compared(number) == []
