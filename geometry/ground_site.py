"""A camera on the ground that observes stars: its position and velocity in GCRS, and astronomical refraction.

Refraction is ERFA's: dz = A tan z + B tan^3 z, z the zenith distance as observed, A and B from the weather.
The vertical is the ellipsoid's normal; its deflection, some 10 arc-seconds, changes refraction by 0.006.
"""

from __future__ import annotations

import erfa
import numpy as np
from numpy.typing import NDArray

from boresight.geometry.constants import WGS84
from boresight.geometry.earth_rotation import EarthRotation
from boresight.geometry.geodesy import ecef_from_geodetic, unit_vectors
from boresight.geometry.record import Floats, array, record, scalar

__all__ = ["Air", "GroundSite", "SiteState", "refract_by_air"]

Array = NDArray[np.float64]

_WAVELENGTH_UM = 0.55  # wavelength for refraction, µm: the middle of visible light
_LOWEST_COSINE = 0.05  # of the zenith distance: 3 degrees above the horizon, where the formula's use ends


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
        p_e = ecef_from_geodetic(self.lat_rad, self.lon_rad, self.height_m, WGS84)
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


def refract_by_air(u_i: Array, air: Air) -> Array:
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
