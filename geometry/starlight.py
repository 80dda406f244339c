"""Apparent directions of stars from a moving satellite or the ground, GCRS axes, from catalogue positions.

Space motion since the catalogue's epoch (a straight line in space, radial velocity included), parallax, light
deflection by the Sun, and aberration by the satellite's barycentric velocity: the Earth's (ERFA's `epv00`)
plus its own. All by ERFA's astrometry routines. Not modelled: deflection by planets (0.02" at Jupiter's limb)
and by the Earth (0.0006" at its limb). Aberration that a star camera has left in its attitudes is taken out.

A camera on the ground (`GroundSite`) sees stars through the air. Refraction is ERFA's: dz = A tan z + B tan^3
z, z the zenith distance as observed, A and B from the weather. The vertical is the ellipsoid's normal; its
deflection, some 10 arc-seconds, changes refraction by 0.006.
"""

from __future__ import annotations

from typing import Any, Literal

import erfa
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from boresight.geometry.constants import SPEED_OF_LIGHT
from boresight.geometry.earth_rotation import EarthRotation
from boresight.geometry.epoch import Epoch
from boresight.geometry.geodesy import ecef_from_geodetic, unit_vectors
from boresight.records.record import Bools, Floats, Ints, RowRecord, array, record, scalar

__all__ = [
    "AberrationRemoved",
    "Air",
    "GroundSite",
    "SiteState",
    "StarPlaces",
    "SurveyedStars",
    "apparent_star_directions",
    "catalogue_directions",
    "earth_velocity_i",
    "refract_by_air",
    "with_all_aberration",
]

AberrationRemoved = Literal["none", "annual", "annual and orbital"]  # from attitudes of a star camera
_AU_PER_DAY = erfa.DAU / erfa.DAYSEC  # m/s
_WAVELENGTH_UM = 0.55  # wavelength for refraction, µm: the middle of visible light
_LOWEST_COSINE = 0.05  # of the zenith distance: 3 degrees above the horizon, where the formula's use ends


@record(kw_only=True)
class StarPlaces(RowRecord):
    """Catalogue positions of N stars, ICRS at `epoch_jyear`. Row n of every array is the same star."""

    hip: Ints = array("N", "Hipparcos numbers")
    ra_rad: Floats = array("N", "right ascension")
    dec_rad: Floats = array("N", "declination")
    pm_ra_rad_yr: Floats = array("N", "d(alpha)/dt, without the factor cos(delta), rad per Julian year")
    pm_dec_rad_yr: Floats = array("N", "d(delta)/dt, rad per Julian year")
    parallax_arcsec: Floats = array("N", "negative values (noise) count as zero")
    radial_velocity_km_s: Floats = array("N", "positive when receding; 0 where unknown")
    v_mag: Floats = array("N", "V magnitude")
    b_v: Floats = array("N", "colour index B - V")
    epoch_jyear: float = scalar("Julian epoch of the positions, 1991.25 for Hipparcos")

    @classmethod
    def uncatalogued(cls, ra_rad: Floats, dec_rad: Floats, v_mag: Floats, epoch_jyear: float) -> StarPlaces:
        """Stars at places (N,) without number, motion and parallax, of the usual colour."""
        motion = ("pm_ra_rad_yr", "pm_dec_rad_yr", "parallax_arcsec", "radial_velocity_km_s")
        none: dict[str, Any] = dict.fromkeys(motion, 0.0 * ra_rad)
        hip, b_v = np.zeros(len(ra_rad), np.int64), np.full(len(ra_rad), 0.6)
        places: dict[str, Any] = {"ra_rad": ra_rad, "dec_rad": dec_rad, "epoch_jyear": epoch_jyear}
        return cls(hip=hip, v_mag=v_mag, b_v=b_v, **places, **none)

    def motions(self) -> Floats:
        """Proper motions (N, 3), rad/yr, GCRS axes."""
        ra, dec = self.ra_rad, self.dec_rad
        east = np.column_stack([-np.sin(ra), np.cos(ra), np.zeros(len(ra))])
        north = np.column_stack([-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)])
        along_east = self.pm_ra_rad_yr * np.cos(dec)
        return np.asarray(along_east[:, None] * east + self.pm_dec_rad_yr[:, None] * north)


@record(kw_only=True)
class SurveyedStars(RowRecord):
    """N stars with the errors that their catalogue states. Row n of every array is the same star."""

    name: str = scalar('of the catalogue, before the number of a star: "HIP"')
    places: StarPlaces = scalar("positions, proper motions and magnitudes")
    sigma_rad: Floats = array("N", "1-sigma of the position at the catalogue's epoch, per axis, rad")
    sigma_pm_rad_yr: Floats = array("N", "1-sigma of the proper motion, per axis, rad per Julian year")
    single: Bools = array("N", "whether the catalogue describes it well by one star in linear motion")

    def sigma_at_rad(self, jyear: float) -> Floats:
        """1-sigma (N,) of the directions at a Julian epoch, per axis, rad."""
        return np.hypot(self.sigma_rad, self.sigma_pm_rad_yr * (jyear - self.places.epoch_jyear))


@record
class GroundSite:
    """Position and weather of an observing site."""

    lat_rad: float = scalar("geodetic latitude, WGS84")
    lon_rad: float = scalar("geodetic longitude, WGS84")
    height_m: float = scalar("above the ellipsoid")
    pressure_hpa: float = scalar("air pressure at the site")
    temperature_c: float = scalar("air temperature at the site, °C")

    @staticmethod
    def in_standard_weather(lat_rad: float, lon_rad: float, height_m: float) -> GroundSite:
        """Site with pressure and temperature of the US Standard Atmosphere 1976 (below 11 km)."""
        kelvin = 288.15 - 6.5e-3 * height_m
        pressure = 1013.25 * (kelvin / 288.15) ** 5.25588
        return GroundSite(lat_rad, lon_rad, height_m, pressure, kelvin - 273.15)

    def at(self, earth: EarthRotation, t_s: float) -> SiteState:
        """Position, velocity and refraction of the site at `t_s` (TAI seconds since `earth.epoch`)."""
        matrix_ie = earth.matrices_ie([t_s])[0]
        p_e = ecef_from_geodetic(self.lat_rad, self.lon_rad, self.height_m)
        up_e = unit_vectors(self.lon_rad, self.lat_rad)
        a, b = erfa.refco(self.pressure_hpa, self.temperature_c, 0.0, _WAVELENGTH_UM)
        air = Air(matrix_ie @ up_e, float(a), float(b))
        return SiteState(matrix_ie @ p_e, matrix_ie @ np.cross(earth.omega_e, p_e), air)


@record
class Air:
    """Refraction above a site: dz = A tan z + B tan³ z."""

    zenith_i: Floats = array("3", "unit vector upwards, GCRS")
    a_rad: float = scalar("coefficient of tan z")
    b_rad: float = scalar("coefficient of tan³ z")


@record
class SiteState:
    """A site at one instant."""

    p_i: Floats = array("3", "geocentric position, GCRS, m")
    v_i: Floats = array("3", "geocentric velocity, GCRS, m/s")
    air: Air = scalar("refraction above the site")


def apparent_star_directions(
    stars: StarPlaces, epoch: Epoch, t_s: float | Floats, p_i: Floats, v_i: Floats
) -> Floats:
    """Apparent unit vectors (N, 3) towards N stars from a moving satellite, GCRS axes: with proper motion,
    parallax, light deflection by the Sun and aberration.

    `t_s` is the instant of observation, or (N,) that of each star, TAI seconds since `epoch`; `p_i`, m, and
    `v_i`, m/s, (3,) or (N, 3), are the satellite's geocentric position and velocity, GCRS.
    """
    years = epoch.julian_year(t_s) - stars.epoch_jyear
    return _seen_by(_observer(epoch, t_s, p_i, v_i), stars, years)


def catalogue_directions(u_i: Floats, epoch: Epoch, t_s: float, p_i: Floats, v_i: Floats) -> Floats:
    """Unit vectors (N, 3), ICRS, without aberration and light deflection, from apparent ones `u_i` (N, 3).

    Inverse of `apparent_star_directions` but for proper motion and parallax; ERFA's `aticq`.
    """
    ra, dec = erfa.aticq(*erfa.c2s(u_i), _observer(epoch, t_s, p_i, v_i))
    return np.asarray(erfa.s2c(ra, dec))


def earth_velocity_i(epoch: Epoch, t_s: Floats) -> Floats:
    """Velocity (N, 3) of the Earth about the barycentre at instants (N,), GCRS axes, m/s."""
    return np.asarray(erfa.epv00(*epoch.tt_jd(t_s))[1]["v"] * _AU_PER_DAY)


def with_all_aberration(
    R_si: Rotation,
    removed: AberrationRemoved,
    epoch: Epoch,
    t_s: Floats,
    v_i: Floats,
    *,
    line_of_sight_s: Floats,
) -> Rotation:
    """Attitudes (N,) as if the head had used apparent directions with annual and orbital aberration.

    A head that compares measured directions with catalogue directions in which an aberration is missing
    reports the attitude that takes the incomplete direction b of its line of sight to that line in the head's
    own axes, which need not be their z. The complete apparent direction there is a, so the attitude in the
    sense of this package is the reported one times the smallest rotation that takes a to b. Stars at an angle
    ρ from the line of sight agree with that to ρ²/4 of the effect.

    `R_si` (N,), GCRS to star camera, is what the head reports at instants `t_s` (N,), TAI seconds since
    `epoch`, having allowed for the aberration `removed`; `v_i` (N, 3) is the geocentric velocity of the
    satellite, GCRS, m/s, and `line_of_sight_s` (3,) the unit vector along the middle of the head's field of
    view, axes of its attitudes.
    """
    if removed == "annual and orbital":
        return R_si
    velocity = v_i
    if removed == "none":
        velocity = v_i + earth_velocity_i(epoch, t_s)
    beta = velocity / SPEED_OF_LIGHT
    b = R_si.inv().apply(line_of_sight_s)
    inverse_gamma = np.sqrt(1.0 - np.einsum("ni,ni->n", beta, beta))
    a = erfa.ab(b, beta, np.ones(len(b)), inverse_gamma)
    normal = np.cross(a, b)
    sine = np.linalg.norm(normal, axis=1, keepdims=True)
    angle = np.arcsin(np.minimum(sine, 1.0))
    rotvec = np.divide(normal * angle, sine, out=np.zeros_like(normal), where=sine > 0.0)
    return R_si * Rotation.from_rotvec(rotvec)


def refract_by_air(u_i: Floats, air: Air) -> Floats:
    """Unit vectors (N, 3), GCRS, as observed through the air, from unit vectors `u_i` (N, 3) outside it.

    As ERFA's `atioq`: one Newton step from the zenith distance outside the atmosphere; below 3 degrees of
    altitude the refraction is that at 3 degrees.
    """
    cosine = u_i @ air.zenith_i
    level = u_i - cosine[:, None] * air.zenith_i
    sine = np.maximum(np.linalg.norm(level, axis=1), 1e-12)
    z = np.maximum(cosine, _LOWEST_COSINE)
    tangent = sine / z
    w = air.b_rad * tangent**2
    lift = (air.a_rad + w) * tangent / (1.0 + (air.a_rad + 3.0 * w) / z**2)
    along = np.cos(lift) * sine - np.sin(lift) * cosine
    up = np.cos(lift) * cosine + np.sin(lift) * sine
    return np.asarray(level * (along / sine)[:, None] + up[:, None] * air.zenith_i)


def _seen_by(observer: NDArray[np.void], stars: StarPlaces, years: Floats) -> Floats:
    """Apparent unit vectors (N, 3) for one observer or N of them, and as many times since the epoch."""
    coordinate = erfa.pmpx(
        stars.ra_rad,
        stars.dec_rad,
        stars.pm_ra_rad_yr,
        stars.pm_dec_rad_yr,
        np.maximum(stars.parallax_arcsec, 0.0),
        stars.radial_velocity_km_s,
        years,
        observer["eb"],
    )
    natural = erfa.ldsun(coordinate, observer["eh"], observer["em"])
    return np.asarray(erfa.ab(natural, observer["v"], observer["em"], observer["bm1"]))


def _observer(epoch: Epoch, t_s: float | Floats, p_i: Floats, v_i: Floats) -> NDArray[np.void]:
    """ERFA's star-independent parameters of a satellite (TT in place of TDB: at most 2 ms)."""
    pv = np.zeros(np.shape(t_s), dtype=erfa.dt_pv)
    pv["p"], pv["v"] = p_i, v_i
    return np.asarray(erfa.apcs13(*epoch.tt_jd(np.asarray(t_s, dtype=float)), pv))
