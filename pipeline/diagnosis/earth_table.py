"""Earth orientation of a dump: is its table new enough for the date, and does a mission's own table agree
with that of the IERS?"""

from __future__ import annotations

import warnings
from collections.abc import Collection, Iterator

import numpy as np

from boresight.calib.finding import Finding
from boresight.gct_match.records import Target
from boresight.geometry.constants import EARTH_ROTATION_RATE, WGS84
from boresight.geometry.earth_orientation import EarthOrientationTable, EarthOrientationWarning
from boresight.geometry.earth_rotation import EarthRotation
from boresight.geometry.orbit import Orbit
from boresight.geometry.record import record, scalar

__all__ = ["EarthTableCheck", "check_earth_table", "earth_findings"]

# m on the equator; a smaller error of predicted values is below that of any orbit and survey
NOTICEABLE_M = 0.1
# m on the equator: a mission that takes one value for several days is off by the length of day, at most 3 ms
# or 1.4 m each day, and by the pole's motion, 0.1 m each day; a table of another month by tens of metres
LARGEST_DIFFERENCE_M = 5.0


@record(kw_only=True)
class EarthTableCheck:
    """How well the Earth orientation that a dump is calibrated with is known at its date."""

    source: str = scalar("the bundled series, or the mission's own file")
    first_day: int = scalar("modified Julian date (UTC) of the first row of the table")
    last_day: int = scalar("the same of the last row")
    last_measured_day: int = scalar("the same of the last row that is no prediction")
    sigma_m: float = scalar("1-sigma of predicted or extrapolated values, on the equator, m; 0: measured")
    difference_m: float = scalar("of the mission's own table from the IERS series, on the equator, m")
    difference_ut1_s: float = scalar("the part of it that is UT1, own less IERS, s")


def check_earth_table(
    orbit: Orbit, table: EarthOrientationTable, reference: EarthOrientationTable
) -> EarthTableCheck:
    """`table` is that of the orbit, `reference` the bundled one, with which it is compared in mid-orbit."""
    middle = 0.5 * (orbit.earth.t_start_s + orbit.earth.t_stop_s)
    turn, sigma_m = np.zeros(3), orbit.earth.expected_error_m
    if table is not reference:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", EarthOrientationWarning)  # sigma_m has it
            iers = EarthRotation.over(orbit.epoch, middle, middle, reference, allow_stale_eop=True)
        turn = (iers.rotations_ie(middle).inv() * orbit.earth.rotations_ie(middle))[0].as_rotvec()
        sigma_m = max(sigma_m, iers.expected_error_m)
    return EarthTableCheck(
        source=table.source,
        first_day=int(table.mjd_utc[0]),
        last_day=int(table.mjd_utc[-1]),
        last_measured_day=int(table.mjd_last_measured),
        sigma_m=sigma_m,
        difference_m=float(np.linalg.norm(turn)) * WGS84.semi_major_m,
        difference_ut1_s=float(turn[2]) / EARTH_ROTATION_RATE,
    )


def earth_findings(check: EarthTableCheck, file: str, places: Collection[Target]) -> Iterator[Finding]:
    """Findings of that check; `file` is the mission's own table, empty for the bundled one.

    A survey has errors. `places` whose 1-sigma are all 0 were computed by the mission's own model, to which
    its table belongs: its difference from the IERS series is then no fault.
    """
    if check.difference_m > max(LARGEST_DIFFERENCE_M, 3.0 * check.sigma_m):
        is_model = len(places) > 0 and not any(place.sigma_m.any() for place in places)
        belongs = "it belongs to exact places, computed with it"
        yield Finding(
            cause="Earth orientation",
            item="own table",
            text=f"{check.difference_m:.0f} m on the equator from the IERS series (UT1 "
            f"{check.difference_ut1_s:+.4f} s); {belongs if is_model else 'take the values of the dates'}.",
            value=check.difference_m,
            sigma=check.sigma_m,
            unit="m",
            is_fault=not is_model,
            file=file,
            field="ut1_utc_s",
        )
    elif check.sigma_m > NOTICEABLE_M and not file:
        yield Finding(
            cause="Earth orientation",
            item="predicted values",
            text=f"{check.sigma_m:.1f} m on the equator (1 sigma), in the covariance; "
            "install a newer astropy-iers-data.",
            sigma=check.sigma_m,
            unit="m",
            is_fault=False,
        )
