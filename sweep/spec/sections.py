"""Target, footprint, air and effects; accuracy, draws, storage and execution of a study."""

from typing import Any

import sweep.spec.declaring as of
from sweep.model.accuracy import AUTOMATIC, COUNTED
from sweep.model.ground import LAWS
from sweep.spec.parts import Part, with_modes, with_parameters


def sunlight(on: str) -> Any:
    """Field of the sunlight on something."""
    about = f"Spectral irradiance of sunlight on the {on}"
    return of.quantity(
        about, "W/m^3", "0.5 W/m^2/nm", "0 W/m^3", "1e18 W/m^3", default=0.0
    )  # fmt: skip


def share_scattered() -> Any:
    """Field of a reflectance."""
    return of.number("Fraction of light scattered back", "0.1", "0", "1")


@with_parameters("target")
class Target(Part):
    """A flat plane, seen at an angle."""

    range: float = of.length("Distance to the target", "2 km", "1 nm", "1e15 m")
    grazing_angle: float = of.angle(
        "Angle between beam and surface, 90 deg along the normal", "15 deg", "1e-6 deg", "90 deg"
    )
    reflectance: float = share_scattered()
    reflectance_law: str = of.choice(
        "How it scatters: Lambertian, as regolith, or as the thesis has it", LAWS, "lambert"
    )
    radial_velocity: float = of.quantity(
        "Speed along the line of sight, positive when closing", "m/s", "150 m/s", default=0.0
    )
    solar_irradiance: float = sunlight("target")


@with_parameters("footprint")
class Footprint(Part):
    """The spot on the target, as a sum of beamlets."""

    beamlets: int = of.count(
        "Number of beamlets; auto: as many as accuracy.tolerance needs where powers add "
        "(each point of a plane and each shot of a flight as many as it needs), else 109",
        "109", "1", "100000", default=0, word="auto",
    )  # fmt: skip
    phases: str = of.choice(
        "Whether the beamlets' optical phases follow the surface or average out",
        ("coherent", "incoherent"),
        "incoherent",
    )


@with_parameters("atmosphere")
class Atmosphere(Part):
    """The air between instrument and target."""


@with_modes
class Effects(Part):
    """Modes of physical effects: simulated where the tolerance needs it, always or never."""


def _share(about: str) -> Any:
    """Part of the tolerance that can be set by hand."""
    about += "; auto: as accuracy.tolerance needs"
    return of.number(about, "1e-6", "0", "1", default=AUTOMATIC, word="auto")


class Accuracy(Part):
    """Accuracy of the computation; part of a study's identity."""

    tolerance: float = of.number(
        "How far a probability of detection, log10 of one of a false alarm or a relative "
        "magnitude may be off by effects left out, all together, and where it is drawn a "
        "probability by the half-width of its interval; 0 simulates all that the scene has",
        "1e-3", "0", "1", default=1e-3,
    )  # fmt: skip
    confidence: float = of.number(
        "Confidence of the intervals of probabilities of detection that a grid draws",
        "0.95", above="0", below="1", default=0.95,
    )  # fmt: skip
    line_error: float = _share("Error of a bin, in noise sigmas, by few lines for many")
    leakage_error: float = _share("Chance of leakage far from the lines that is not looked for")
    leakage_floor: float = of.number(
        "Bins with less leaked signal than so many noise sigmas count as noise alone, "
        "where bins are taken one by one: in draws, padded FFTs, tabulated windows, under a "
        "Gaussian line; auto: as accuracy.leakage_error allows",
        "0.1", "1e-9", "1000", default=AUTOMATIC, word="auto",
    )  # fmt: skip


SPECTRA = "spectra"
"""Method of draws that are whole spectra."""


class Draws(Part):
    """Random realisations of each point."""

    number: int = of.count(
        "Draws a point; 0 computes probabilities alone", "10000", "0", "1e12", default=0
    )
    limit: int = of.count(
        "Draws of a point at most, where it draws until accuracy.tolerance is met; 0 draws "
        "draws.number instead",
        "1e5", "0", "1e12", default=0,
    )  # fmt: skip
    batch: int = of.count("Draws that are counted together", "100", "1", "1e9", default=100)
    method: str = of.choice(
        "Draw against the probabilities, add noise to the bins that matter, or draw "
        "whole spectra for instrument.processing.detector and .estimator to look at",
        ("probabilities", "noise", SPECTRA),
        "probabilities",
    )
    interval: str = of.choice(
        "Interval of the share of draws with a detection, where noise alone is drawn: "
        "at least as sure as promised everywhere, or on the average",
        tuple(COUNTED),
        "clopper_pearson",
    )

    @property
    def any(self) -> bool:
        """True if anything is drawn."""
        return self.number > 0 or self.adaptive

    @property
    def whole_spectra(self) -> bool:
        """True if a detector and an estimator look at whole spectra."""
        return self.method == SPECTRA

    @property
    def adaptive(self) -> bool:
        """True if each point is drawn until its accuracy is met."""
        return self.limit > 0


class Storage(Part):
    """Division of results in the store; part of a study's identity."""

    block_points: int = of.count(
        "Points that one block holds at most; 0 for 65536, and more in studies so large that "
        "their files would be too many to handle",
        "65536", "0", "1e9", default=0,
    )  # fmt: skip


class Execution(Part):
    """Execution of a study; never part of its identity, as it changes no result."""

    workers: int = of.count("Worker processes; 0 for one a core", "4", "0", "100000", default=0)
    threads: int = of.count("Threads of one worker", "1", "1", "10000", default=1)
    scheduler: str = of.text(
        "'none' for a plain loop without Dask; empty for workers on this machine",
        "",
        pattern="(none)?",
        remedy="an address is no part of a spec, which a stranger may have written: "
        "say --scheduler ADDRESS, or --cluster FILE",
    )
