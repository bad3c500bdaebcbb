"""Atmosphere between lidar and target: extinction of the light, and backscatter.

The extinction coefficient alpha [1/m] is a table over height above the ground. Between two heights
it is exponential (linear if one end is 0). Below the first height it is constant, above the last it
is 0. An exponential atmosphere is thus a table of two rows, and its optical depth has a closed
form. Paths are straight and the ground is level: they are short against the planet's radius.

Sources of the tables:

- Earth: Koschmieder's law with the wavelength exponent of Kruse, McGlauchlin and McQuistan
  (Elements of Infrared Technology, 1962) as revised by Kim, McArthur and Korevaar (Proc. SPIE 4214,
  2001) below 6 km; visibility 23 km (clear) and 5 km (haze); aerosol scale height 1.2 km (Elterman,
  AFCRL-68-0153, 1968). Molecules add less than 2e-7/m at 1.55 um.
- Mars: well-mixed dust of scale height 11 km (Conrath, Icarus 24, 1975). Optical depths are 0.5 (a
  usual season), 1 and 5 (a global storm), after the record of Lemmon et al., Icarus 251, 2015, at
  0.88 um. Extinction by grains of 1.5 um is the same at 1.55 um to some 10 %.
- Lidar ratios: haze 30 to 70 sr, Martian dust about 40 sr, water drops 18 sr.

References
----------
The factor T^2 of transmission T is that of PHYSICS section 3; the range equation [T 4.4] leaves the
air out. Backscatter is the single-scattering lidar equation (:func:`backscatter_integral`).
"""

import itertools
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sweep.model import beam
from sweep.model.effects import noise_sources
from sweep.model.effects.effect import Effect, EffectContext, Parameter, add_noise_sources
from sweep.model.effects.error_bounds import ErrorBound
from sweep.model.effects.planner_inputs import PlannerInputs
from sweep.model.effects.requirements import positive_value_requirement
from sweep.model.link_budget import BEAM_ELEVATION_PATH, LASER_PREFIX, TELESCOPE_PREFIX
from sweep.model.preparation import Shots
from sweep.model.receiver_chain import aperture_area

_PATH_HEIGHT_DIFFERENCE_MIN = 1e-9
"""Smallest difference of height [m] between the ends of a path. Paths whose difference is
smaller count as having this one, so that the mean extinction over height is defined."""


class ExtinctionProfile(NamedTuple):
    """Extinction coefficient of the air, tabulated over height above the ground.

    The coefficient is exponential between two heights, constant below the first, and 0 above the
    last.
    """

    height: tuple[float, ...]
    """Heights above the ground [m], ascending; a height appears twice for a step."""
    extinction: tuple[float, ...]
    """Extinction coefficient at each height [1/m], >= 0."""


def exponential_profile(*, surface_extinction: float, scale_height: float) -> ExtinctionProfile:
    """Return the extinction profile of an exponential atmosphere, 40 scale heights high.

    Parameters
    ----------
    surface_extinction : float
        Extinction coefficient at the ground [1/m].
    scale_height : float
        Height [m] over which the extinction falls by the factor e.

    Returns
    -------
    ExtinctionProfile
    """
    top_scale_heights = 40.0
    return ExtinctionProfile(
        (0.0, top_scale_heights * scale_height),
        (surface_extinction, surface_extinction * math.exp(-top_scale_heights)),
    )


def layer_profile(*, optical_depth: float, depth: float) -> ExtinctionProfile:
    """Return the extinction profile of a uniform layer on the ground.

    Parameters
    ----------
    optical_depth : float
        Vertical optical depth of the layer.
    depth : float
        Height of the layer [m].

    Returns
    -------
    ExtinctionProfile
    """
    return ExtinctionProfile((0.0, depth), (optical_depth / depth, optical_depth / depth))


def extinction_from_visibility(*, visibility: ArrayLike, wavelength: ArrayLike) -> np.ndarray:
    """Return the extinction of haze from the visibility, after Kruse and Kim.

    Parameters
    ----------
    visibility : array_like
        Visibility V [m], 2 % contrast at 0.55 um.
    wavelength : array_like
        Wavelength [m].

    Returns
    -------
    ndarray
        Extinction coefficient [1/m].

    Notes
    -----
    The coefficient is 3.912/V (wavelength / 0.55 um)^-q. The exponent q depends on the visibility V
    [km]: 1.6 above 50 km, 1.3 above 6 km, 0.16 V + 0.34 above 1 km, V - 0.5 above 0.5 km, and 0 in
    fog. The module's description has the sources.
    """
    visibility_m = np.asarray(visibility, float)
    visibility_km = visibility_m / 1e3
    wavelength_exponent = np.select(
        [visibility_km > 50, visibility_km > 6, visibility_km > 1, visibility_km > 0.5],
        [1.6, 1.3, 0.16 * visibility_km + 0.34, visibility_km - 0.5],
        default=0.0,
    )
    return (
        -math.log(0.02)
        / visibility_m
        * (np.asarray(wavelength, float) / 0.55e-6) ** -wavelength_exponent
    )


def _haze_profile(visibility: float) -> ExtinctionProfile:
    """Return the extinction profile of haze on Earth for a visibility [m]."""
    surface_extinction = extinction_from_visibility(visibility=visibility, wavelength=1.55e-6)
    return exponential_profile(surface_extinction=float(surface_extinction), scale_height=1.2e3)


def _dust_profile(optical_depth: float) -> ExtinctionProfile:
    """Return the extinction profile of Martian dust of a vertical optical depth."""
    return exponential_profile(surface_extinction=optical_depth / 11e3, scale_height=11e3)


EXTINCTION_PROFILES = {
    "earth_clear": _haze_profile(23e3),
    "earth_haze": _haze_profile(5e3),
    "mars_clear": _dust_profile(0.5),
    "mars_dusty": _dust_profile(1.0),
    "mars_storm": _dust_profile(5.0),
}
"""Extinction profiles of the atmospheres that a spec can select, by name."""


def optical_depth(
    profile: ExtinctionProfile, *, start_height: ArrayLike, end_height: ArrayLike, range: ArrayLike
) -> np.ndarray:
    """Compute the one-way optical depth (the integral of extinction) of a straight path.

    Parameters
    ----------
    profile : ExtinctionProfile
        Extinction over height.
    start_height, end_height : array_like
        Heights of the path's ends [m].
    range : array_like
        Length of the path [m].

    Returns
    -------
    ndarray
        Optical depth >= 0, in the shape to which the arguments broadcast.
    """
    end_heights = np.broadcast_arrays(
        np.asarray(start_height, float), np.asarray(end_height, float)
    )
    low, high = np.minimum(*end_heights), np.maximum(*end_heights)
    # At great heights, where float64 cannot resolve this difference, the smallest that it can.
    difference_min = np.maximum(
        _PATH_HEIGHT_DIFFERENCE_MIN, 4 * np.spacing(np.maximum(np.abs(low), np.abs(high)))
    )
    widening = np.maximum(difference_min - (high - low), 0.0) / 2
    low, high = low - widening, high + widening
    lower_heights = (-np.inf, *profile.height[:-1])
    lower_extinctions = (profile.extinction[0], *profile.extinction[:-1])
    total = np.zeros(low.shape)
    for z0, z1, a0, a1 in zip(
        lower_heights, profile.height, lower_extinctions, profile.extinction, strict=True
    ):
        start, end = np.clip(low, z0, z1), np.clip(high, z0, z1)
        total += (end - start) * _mean_extinction(start, end, z0, z1, a0, a1)
    return np.asarray(total / (high - low) * np.asarray(range, float))


def _mean_extinction(
    start: np.ndarray, end: np.ndarray, z0: float, z1: float, a0: float, a1: float
) -> np.ndarray | float:
    """Return the mean extinction [1/m] over the heights from ``start`` to ``end``.

    The heights lie between two rows of a profile: extinction ``a0`` at the height ``z0``, and
    ``a1`` at ``z1``. Between them extinction is exponential, or linear if ``a0`` or ``a1`` is 0.
    """
    if a0 == a1 or z0 == z1 or not math.isfinite(z0):
        return a0
    if a0 > 0 and a1 > 0:
        rate = math.log(a1 / a0) / (z1 - z0)
        x = rate * (end - start)
        growth = np.where(x == 0, 1.0, np.expm1(x) / np.where(x == 0, 1.0, x))
        return np.asarray(a0 * np.exp(rate * (start - z0)) * growth)
    return np.asarray(a0 + (a1 - a0) * ((start + end) / 2 - z0) / (z1 - z0))


def extinction_profile(parameters: Mapping[str, np.ndarray]) -> ExtinctionProfile | None:
    """Return the extinction profile that all points share, or None without an atmosphere.

    ``parameters`` are those of the points by dotted path; text parameters are equal in all points.
    """
    name = str(parameters["atmosphere.profile"])
    surface_extinction, depth = (
        float(parameters["atmosphere.extinction"]),
        float(parameters["atmosphere.depth"]),
    )
    if name == "exponential":
        return exponential_profile(surface_extinction=surface_extinction, scale_height=depth)
    if name == "layer":
        return layer_profile(optical_depth=surface_extinction * depth, depth=depth)
    return EXTINCTION_PROFILES.get(name)


def path_end_heights(
    parameters: Mapping[str, np.ndarray], range: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the heights of lidar and target above the ground.

    Parameters
    ----------
    parameters : mapping
        Parameters by dotted path, (n,) or scalar: kind of the path, height of the target [m], and
        elevation of the beam (its angle below the horizon [rad]). Without an elevation the target's
        grazing angle [rad] stands for it.
    range : ndarray (n,)
        Range of the target [m].

    Returns
    -------
    lidar_height : ndarray (n,)
        Target's height plus range * sin(elevation) [m]; the target's height on a level path.
    target_height : ndarray (n,)
        Height of the target [m].
    """
    target_height = np.asarray(parameters["atmosphere.target_height"], float) + np.zeros_like(range)
    if str(parameters["atmosphere.path"]) == "level":
        return target_height, target_height
    elevation = parameters.get(BEAM_ELEVATION_PATH, parameters.get("target.grazing_angle"))
    return target_height + range * np.sin(np.asarray(elevation, float)), target_height


def _path_geometry(
    parameters: Mapping[str, np.ndarray], range: np.ndarray
) -> dict[str, np.ndarray]:
    """Return heights and length of the path, as arguments of :func:`optical_depth`."""
    lidar_height, target_height = path_end_heights(parameters, range)
    return {"start_height": lidar_height, "end_height": target_height, "range": range}


def apply_extinction(shots: Shots, context: EffectContext) -> Shots:
    """Attenuate echoes and light from the ground by the transmission of the air.

    Parameters
    ----------
    shots : Shots
        Prepared shots of n points (:class:`sweep.model.preparation.Shots`).
    context : EffectContext
        Parameters of atmosphere and beam; the ground is not used
        (:class:`sweep.model.effects.effect.EffectContext`).

    Returns
    -------
    Shots
        Shots with attenuated echoes and ground light, or unchanged without an atmosphere.

    Notes
    -----
    With the one-way transmission T = exp(-optical depth), echo power is multiplied by T^2 (PHYSICS
    section 3), and light from the ground, such as sunlight, by T. The beat's amplitude is
    multiplied by T, or with direct detection by T^2.
    """
    profile = extinction_profile(context.parameters)
    if profile is None:
        return shots
    transmission = np.exp(
        -optical_depth(profile, **_path_geometry(context.parameters, shots.range))
    )
    is_direct = shots.waveform.architecture == "direct"
    echo_scales = shots.echo_scales.with_scaled_echo(
        power_factor=transmission**2,
        amplitude_factor=transmission**2 if is_direct else transmission,
    )
    ground_light_transmission = echo_scales.ground_light_transmission * transmission
    return replace(
        shots, echo_scales=echo_scales._replace(ground_light_transmission=ground_light_transmission)
    )


def extinction_error_bound(points: PlannerInputs) -> ErrorBound | None:
    """Return bounds on the changes of the echo and of shot noise if extinction is omitted.

    The shot noise is that of light from the target.
    """
    profile = extinction_profile(points.parameters)
    if profile is None:
        return None
    transmission = np.exp(
        -optical_depth(profile, **_path_geometry(points.parameters, points.range))
    )
    light_noise_ratio = points.echo_shot_noise_ratio
    if (solar_bound := noise_sources.solar_background_error_bound(points)) is not None:
        light_noise_ratio = light_noise_ratio + solar_bound.noise_variance_change
    # The threshold follows the sunlight's part, not the echo's. The worse case is assumed for both.
    return ErrorBound(
        magnitude_change=1
        - (transmission**2 if points.waveform.architecture == "direct" else transmission),
        noise_variance_change=-(1 - transmission**2) * light_noise_ratio / (1 + light_noise_ratio),
        threshold_follows_noise=False,
    )


EXTINCTION = Effect(
    name="extinction",
    description="air, haze and dust that dim the light",
    stage="light",
    error_bound=extinction_error_bound,
    apply=apply_extinction,
    parameters=(
        Parameter(
            path="atmosphere.profile",
            description="Extinction over height: none, one of the tables, an exponential one, an "
            "even "
            "layer",
            default="none",
            options=("none", *EXTINCTION_PROFILES, "exponential", "layer"),
            requirements=(
                positive_value_requirement(
                    "atmosphere.extinction",
                    applies_to=lambda profile: np.isin(profile, ("exponential", "layer")),
                ),
            ),
        ),
        Parameter(
            path="atmosphere.extinction",
            description="Extinction coefficient on the ground, of the profiles exponential and "
            "layer",
            example="1e-4 1/m",
            limits=("0 1/m", "1e9 1/m"),
            is_category_key=True,
        ),
        Parameter(
            path="atmosphere.depth",
            description="Scale height of the profile exponential, depth of the profile layer",
            default=1e3,
            example="1 km",
            limits=("1 um", "1e15 m"),
            si_unit="m",
            is_category_key=True,
        ),
        Parameter(
            path="atmosphere.path",
            description="Whether the beam slants down at the grazing angle, or runs level over the "
            "ground",
            default="slant",
            options=("slant", "level"),
        ),
        Parameter(
            path="atmosphere.target_height",
            description="Height of the target above the ground that profiles count from",
            example="10 m",
            limits=("-20 km", "1000 km"),
            si_unit="m",
        ),
    ),
)
"""Effect that attenuates echo and sunlight by the extinction of air, haze and dust."""


_GAUSS_NODES, _GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(16)
_INTEGRAL_SPLIT_E_FOLDINGS = (0.0, 1.0, 3.0, 7.0, 15.0, 40.0)
"""Distances from the denser of two rows of an extinction profile at which the backscatter integral
is split, in e-foldings of the extinction."""
_INTEGRAL_SPLIT_RANGE_RATIOS = (1.0, 2.0, 4.0, 10.0, 30.0, 100.0)
"""Ranges at which the backscatter integral splits the path, in units of the near range (aperture
diameter over full angle of the field of view)."""


def backscatter_integral(
    profile: ExtinctionProfile,
    *,
    start_height: ArrayLike,
    end_height: ArrayLike,
    range: ArrayLike,
    near_range: ArrayLike,
) -> np.ndarray:
    """Integrate the backscatter of the air from a continuous beam over the path to the target.

    Parameters
    ----------
    profile : ExtinctionProfile
        Extinction alpha over height.
    start_height, end_height, range : array_like
        Heights of the path's ends and its length R [m], as in :func:`optical_depth`.
    near_range : array_like
        r_0 = D/Theta [m]: diameter of the aperture over full angle of the field of view.

    Returns
    -------
    ndarray
        Integral of alpha(r) T(r)^2 / (r^2 + r_0^2) over 0..R [1/m^2], with a relative error of
        1e-8. T(r) is the one-way transmission to the range r.

    Notes
    -----
    The air returns P_tx A tau_o / S times the integral to the detector [W]. P_tx is the transmitted
    power, A the aperture's area, tau_o the transmission of the optics, and S the lidar ratio [sr].
    The factor r^2 / (r^2 + r_0^2) is the overlap of a collimated beam with its own receiver:
    nearer than r_0, the image of a point is larger than the field of view. For a
    diffraction-limited beam, Theta = 4 lambda / (pi D), the factor is that of a coherent lidar
    focused at infinity [1]_.

    Gauss-Legendre quadrature over atan(r / r_0) is applied to sections of the path. Sections end at
    the rows of the profile that the path crosses, and where extinction or overlap has fallen by
    certain factors.

    References
    ----------
    .. [1] Sonnenschein and Horrigan, Appl. Opt. 10, 1971, 1600.
    """
    columns = (np.asarray(value, float) for value in (start_height, end_height, range, near_range))
    lidar_height, target_height, target_range, near_range = (
        np.expand_dims(column, -1) for column in np.broadcast_arrays(*columns)
    )
    height_difference = target_height - lidar_height
    crossing_fraction = (_integral_split_heights(profile) - lidar_height) / np.where(
        height_difference == 0, np.inf, height_difference
    )
    inner_cuts = [
        np.clip(crossing_fraction, 0, 1) * target_range,
        np.minimum(np.asarray(_INTEGRAL_SPLIT_RANGE_RATIOS) * near_range, target_range),
    ]
    cuts = np.sort(
        np.concatenate([np.zeros_like(target_range), *inner_cuts, target_range], axis=-1), axis=-1
    )
    angle = np.arctan(cuts / near_range)
    half_width = np.diff(angle)[..., None] / 2
    node_angle = (angle[..., :-1, None] + half_width) + half_width * _GAUSS_NODES
    distance = near_range[..., None] * np.tan(node_angle)
    height = lidar_height[..., None] + height_difference[..., None] * (
        distance / target_range[..., None]
    )
    depth = optical_depth(
        profile, start_height=lidar_height[..., None], end_height=height, range=distance
    )
    extinction = optical_depth(profile, start_height=height, end_height=height, range=1.0)
    total = (half_width * _GAUSS_WEIGHTS * extinction * np.exp(-2 * depth)).sum(axis=(-1, -2))
    return np.asarray(total / near_range[..., 0])


def _integral_split_heights(profile: ExtinctionProfile) -> np.ndarray:
    """Return the heights [m] at which the backscatter integral is split.

    They are the heights of the profile's rows, and heights between rows
    (``_INTEGRAL_SPLIT_E_FOLDINGS``).
    """
    cuts = [profile.height[0]]
    rows = [*zip(profile.height, profile.extinction, strict=True)]
    for (z0, a0), (z1, a1) in itertools.pairwise(rows):
        e_foldings = abs(math.log(a1 / a0)) if a0 > 0 and a1 > 0 else 0.0
        steps = [
            e_folding / e_foldings
            for e_folding in _INTEGRAL_SPLIT_E_FOLDINGS
            if e_folding < e_foldings
        ]
        cuts += [z0 + step * (z1 - z0) if a1 < a0 else z1 - step * (z1 - z0) for step in steps]
        cuts.append(z1)
    return np.array(cuts)


def _backscattered_power(parameters: Mapping[str, np.ndarray], integral: np.ndarray) -> np.ndarray:
    """Return the power [W] of light that the air returns to the detector.

    ``integral`` [1/m^2] is that of :func:`backscatter_integral`.
    """
    collected_power = parameters[LASER_PREFIX + "power"] * aperture_area(
        beam.receiver_diameter_and_view_angle(parameters)[0]
    )
    collected_power = collected_power * parameters[TELESCOPE_PREFIX + "optical_efficiency"]
    return np.asarray(collected_power * integral / parameters["atmosphere.lidar_ratio"])


def apply_backscatter(shots: Shots, context: EffectContext) -> Shots:
    """Add the shot noise of backscattered light.

    Parameters
    ----------
    shots : Shots
        Prepared shots of n points (:class:`sweep.model.preparation.Shots`).
    context : EffectContext
        Parameters of atmosphere, laser and telescope; the ground is not used
        (:class:`sweep.model.effects.effect.EffectContext`).

    Returns
    -------
    Shots
        Shots with the noise source ``backscatter_shot`` [V^2], or unchanged without an atmosphere.

    Notes
    -----
    The current variance is 2 q M^2 F Re P B_e, with the elementary charge q, the detector's gain M,
    excess noise factor F and responsivity Re, and the electrical bandwidth B_e. The power P [W] is
    P_tx A tau_o / S times the integral of :func:`backscatter_integral`.

    The beat of backscattered light with the local oscillator is neglected. Backscattered light
    comes from grains that change all the time, and is spread over the bins from the nearest range
    to the target's. [T 3.3.2] counts backscatter as noise as well.
    """
    parameters = context.parameters
    profile = extinction_profile(parameters)
    if profile is None:
        return shots
    aperture, field_angle = beam.receiver_diameter_and_view_angle(parameters)
    power = _backscattered_power(
        parameters,
        backscatter_integral(
            profile, near_range=aperture / field_angle, **_path_geometry(parameters, shots.range)
        ),
    )
    return add_noise_sources(
        shots,
        backscatter_shot=np.asarray(shots.receiver_noise.shot_noise_variance_per_watt * power),
    )


def backscatter_error_bound(points: PlannerInputs) -> ErrorBound | None:
    """Return a bound on the shot noise of backscattered light, relative to the receiver's noise.

    The threshold is set on noise that includes this shot noise. The bound is the smaller of two.
    The first assumes that the air of the path's lower end fills the path, without extinction. The
    second assumes that all light lost on the path returns from the beam's near end.
    """
    parameters = points.parameters
    profile = extinction_profile(parameters)
    if profile is None:
        return None
    path_geometry = _path_geometry(parameters, points.range)
    aperture, field_angle = beam.receiver_diameter_and_view_angle(parameters)
    lowest_height = np.minimum(path_geometry["start_height"], path_geometry["end_height"])
    near_range = aperture / field_angle
    extinction = optical_depth(
        profile, start_height=lowest_height, end_height=lowest_height, range=1.0
    )
    uniform_bound = extinction * np.arctan(points.range / near_range) / near_range
    integral_max = np.minimum(
        uniform_bound, -np.expm1(-2 * optical_depth(profile, **path_geometry)) / 2 / near_range**2
    )
    return ErrorBound(
        noise_variance_change=_backscattered_power(parameters, integral_max)
        * points.receiver_noise.shot_noise_variance_per_watt
        / points.noise.variance_without_echo
    )


BACKSCATTER = Effect(
    name="backscatter",
    description="shot noise of light that the air sends back",
    stage="noise",
    error_bound=backscatter_error_bound,
    apply=apply_backscatter,
    parameters=(
        Parameter(
            path="atmosphere.lidar_ratio",
            description="Extinction over backscatter",
            default=50.0,
            example="50 sr",
            limits=("1e-6 sr", "1e9 sr"),
        ),
    ),
)
"""Effect that adds the shot noise of light that the air scatters back to the receiver."""
