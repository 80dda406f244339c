"""Constants of nature and of the Earth, each once, beside its source. SI units and radians."""

from __future__ import annotations

import math

from boresight.records.record import record

__all__ = [
    "ABERRATION",
    "ARCSEC",
    "DAY_S",
    "EARTH_ROTATION_RATE",
    "GM_EARTH",
    "J2_EARTH",
    "SPEED_OF_LIGHT",
    "WGS84",
    "Ellipsoid",
]

SPEED_OF_LIGHT = 299_792_458.0  # m/s, exact (SI)
DAY_S = 86_400.0  # s
ABERRATION = 9.94e-5  # mean speed of the Earth over that of light: largest relative change of angles by it
ARCSEC = math.pi / 648_000.0  # rad
EARTH_ROTATION_RATE = 2.0 * math.pi * 1.00273781191135448 / DAY_S  # rad/s (IERS 2010, 5.15)
GM_EARTH = 3.986004418e14  # m^3/s^2 (IERS Conventions 2010, table 1.1)
J2_EARTH = 1.0826359e-3  # (IERS Conventions 2010, table 1.1)


@record(by_value=True)
class Ellipsoid:
    """An ellipsoid of revolution: semi-major axis (m) and flattening."""

    semi_major_m: float
    flattening: float

    @property
    def semi_minor_m(self) -> float:
        """Semi-minor axis, m."""
        return self.semi_major_m * (1.0 - self.flattening)

    @property
    def eccentricity_squared(self) -> float:
        """Square of the first eccentricity."""
        return self.flattening * (2.0 - self.flattening)


WGS84 = Ellipsoid(6_378_137.0, 1.0 / 298.257223563)  # NGA.STND.0036
