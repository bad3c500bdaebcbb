"""What an instrument looks at, how closely it is computed, and how a study is run."""

from typing import Annotated

from sweep.model.accuracy import AUTOMATIC, COUNTED
from sweep.model.ground import LAWS
from sweep.spec.effect_fields import with_modes, with_parameters
from sweep.spec.instrument import Part
from sweep.spec.quantities import count
from sweep.spec.rules import Choice, Numeric, Text


@with_parameters("target")
class Target(Part):
    """A flat plane, seen at an angle."""

    range: Annotated[
        float,
        Numeric(
            about="Distance to the target",
            si_unit="m",
            example="2 km",
            at_least="1 nm",
            at_most="1e15 m",
        ),
    ]
    grazing_angle: Annotated[
        float,
        Numeric(
            about="Angle between beam and surface, 90 deg along the normal",
            si_unit="rad",
            example="15 deg",
            at_least="1e-6 deg",
            at_most="90 deg",
        ),
    ]
    reflectance: Annotated[
        float,
        Numeric(about="Fraction of light scattered back", example="0.1", at_least="0", at_most="1"),
    ]
    reflectance_law: Annotated[
        str,
        Choice(
            about="How it scatters: Lambertian, as regolith, or as the thesis has it",
            options=LAWS,
        ),
    ] = "lambert"
    radial_velocity: Annotated[
        float,
        Numeric(
            about="Speed along the line of sight, positive when closing",
            si_unit="m/s",
            example="150 m/s",
            at_least="-1000 km/s",
            at_most="1000 km/s",
        ),
    ] = 0.0
    solar_irradiance: Annotated[
        float,
        Numeric(
            about="Spectral irradiance of sunlight on the target",
            si_unit="W/m^3",
            example="0.5 W/m^2/nm",
            at_least="0 W/m^3",
            at_most="1e18 W/m^3",
        ),
    ] = 0.0


@with_parameters("footprint")
class Footprint(Part):
    """The spot on the target, as a sum of beamlets."""

    beamlets: Annotated[
        int,
        Numeric(
            about="Number of beamlets; auto: as many as accuracy.tolerance needs where powers add "
            "(each point of a plane and each shot of a flight as many as it needs), else 109",
            example="109",
            at_least="1",
            at_most="100000",
            whole=True,
            words=(("auto", 0),),
        ),
    ] = 0
    phases: Annotated[
        str,
        Choice(
            about="Whether the beamlets' optical phases follow the surface or average out",
            options=("coherent", "incoherent"),
        ),
    ] = "incoherent"


@with_parameters("atmosphere")
class Atmosphere(Part):
    """The air between instrument and target."""


@with_modes
class Effects(Part):
    """Which physical effects are simulated: where the scene calls for it, always or never."""


def _share(about: str) -> Numeric:
    """Rule of a part of the tolerance that can be set by hand."""
    return Numeric(
        about=f"{about}; auto: as accuracy.tolerance needs",
        example="1e-6",
        at_least="0",
        at_most="1",
        words=(("auto", int(AUTOMATIC)),),
    )


class Accuracy(Part):
    """How far the computation goes; part of a study's identity."""

    tolerance: Annotated[
        float,
        Numeric(
            about="How far a probability of detection, log10 of one of a false alarm or a relative "
            "magnitude may be off by effects left out, all together, and where it is drawn a "
            "probability by the half-width of its interval; 0 simulates all that the scene has",
            example="1e-3",
            at_least="0",
            at_most="1",
        ),
    ] = 1e-3
    confidence: Annotated[
        float,
        Numeric(
            about="Confidence of the intervals of probabilities of detection that a grid draws",
            example="0.95",
            above="0",
            below="1",
        ),
    ] = 0.95
    line_error: Annotated[
        float, _share("Error of a bin, in noise sigmas, by few lines for many")
    ] = AUTOMATIC
    leakage_error: Annotated[
        float, _share("Chance of leakage far from the lines that is not looked for")
    ] = AUTOMATIC
    leakage_floor: Annotated[
        float,
        Numeric(
            about="Bins with less leaked signal than so many noise sigmas count as noise alone, "
            "where bins are taken one by one: in draws, padded FFTs, tabulated windows, under a "
            "Gaussian line; auto: as accuracy.leakage_error allows",
            example="0.1",
            at_least="1e-9",
            at_most="1000",
            words=(("auto", int(AUTOMATIC)),),
        ),
    ] = AUTOMATIC


SPECTRA = "spectra"
"""Method of draws that are whole spectra."""


class Draws(Part):
    """Random realisations of each point."""

    number: Annotated[
        int,
        count(
            "Draws a point; 0 computes probabilities alone", "10000", at_least="0", at_most="1e12"
        ),
    ] = 0
    limit: Annotated[
        int,
        count(
            "Draws of a point at most, where it draws until accuracy.tolerance is met; 0 draws "
            "draws.number instead",
            "1e5",
            at_least="0",
            at_most="1e12",
        ),
    ] = 0
    batch: Annotated[int, count("Draws that are counted together", "100", at_most="1e9")] = 100
    method: Annotated[
        str,
        Choice(
            about="Draw against the probabilities, add noise to the bins that matter, or draw "
            "whole spectra for instrument.processing.detector and .estimator to look at",
            options=("probabilities", "noise", SPECTRA),
        ),
    ] = "probabilities"
    interval: Annotated[
        str,
        Choice(
            about="Interval of the share of draws with a detection, where noise alone is drawn: "
            "at least as sure as promised everywhere, or on the average",
            options=tuple(COUNTED),
        ),
    ] = "clopper_pearson"

    @property
    def any(self) -> bool:
        """Whether anything is drawn."""
        return self.number > 0 or self.adaptive

    @property
    def whole_spectra(self) -> bool:
        """Whether a detector and an estimator look at whole spectra."""
        return self.method == SPECTRA

    @property
    def adaptive(self) -> bool:
        """Whether each point is drawn until its accuracy is met."""
        return self.limit > 0


class Storage(Part):
    """How results are cut up in the store; part of a study's identity."""

    block_points: Annotated[
        int,
        count(
            "Points that one block holds at most; 0 for 65536, and more in studies so large that "
            "their files would be too many to handle",
            "65536",
            at_least="0",
            at_most="1e9",
        ),
    ] = 0


class Execution(Part):
    """How a study is run; never part of its identity, as it changes no result."""

    workers: Annotated[
        int, count("Worker processes; 0 for one a core", "4", at_least="0", at_most="100000")
    ] = 0
    threads: Annotated[int, count("Threads of one worker", "1", at_most="10000")] = 1
    scheduler: Annotated[
        str,
        Text(
            about="'none' for a plain loop without Dask; empty for workers on this machine",
            pattern="(none)?",
            remedy="an address is no part of a spec, which a stranger may have written: "
            "say --scheduler ADDRESS, or --cluster FILE",
        ),
    ] = ""
