"""Places on the ground as directions from the satellite, with light time, aberration and refraction."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from boresight.accepted import column_of, label_of, number_of, of_argument, rows_of, utc_of, wrong
from boresight.geometry.geodesy import ecef_from_geodetic, local_axes_e, unit_vectors
from boresight.geometry.geoid import egm96
from boresight.geometry.groundlight import LightEffects, apparent_ground_directions
from boresight.geometry.orbit import Orbit
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.orbit_and_earth import bundled_table, orbit_of
from boresight.pipeline.files.orbit_file import read_oem
from boresight.records.record import Floats, Texts, array, record

__all__ = ["SeenPlaces", "orbit_of_states", "seen_places"]

HEIGHT_KINDS = ("ellipsoidal", "egm96")
LIMITS = {"lat_deg": (-90.0, 90.0), "lon_deg": (-360.0, 360.0), "height_m": (-500.0, 9000.0)}
SIGMAS = ("sigma_east_m", "sigma_north_m", "sigma_up_m")
ONE_INSTANT_S = 1e-3  # of all targets of a frame, which has one attitude: 0.2 arcsec of a nadir-pointing one


@record(kw_only=True)
class SeenPlaces:
    """Places on the ground that a satellite sees. Row n of every array is the same target."""

    u_i: Floats = array("J, 3", "apparent directions, GCRS")
    covariance: Floats = array("J, 3, 3", "of the directions, by errors of the places, GCRS, rad²")
    place: Texts = array("J", "equal for one place")

    @classmethod
    def together(cls, parts: Sequence[SeenPlaces]) -> SeenPlaces:
        """The places of several frames, one after another."""
        return cls(
            **{n: np.concatenate([getattr(one, n) for one in parts]) for n in ("u_i", "covariance", "place")}
        )


def orbit_of_states(text: str) -> Orbit:
    """The orbit of an orbit message; `ValueError` where its states are no orbit."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "orbit.oem"
        path.write_text(text, encoding="utf-8")
        try:
            return orbit_of(read_oem(path, "orbit"), "orbit", bundled_table(), allow_stale_eop=False)
        except RawDataError as error:
            raise of_argument("orbit", error) from error


def seen_places(table: Any, name: str, orbit: Orbit) -> SeenPlaces:
    """Directions of a frame's targets: rows of lat_deg, lon_deg, height_m, time and, if they are not exact,
    sigma_east_m, sigma_north_m, sigma_up_m.
    """
    rows = rows_of(table, name)

    def column(key: str, low: float, high: float, otherwise: float | None = None) -> Floats:
        return np.array(column_of(rows, key, name, partial(number_of, low=low, high=high), otherwise))

    lat_deg, lon_deg, height_m = (column(key, *LIMITS[key]) for key in LIMITS)
    lat, lon = np.radians(lat_deg), np.radians(lon_deg)
    kinds = column_of(rows, "height_kind", name, label_of, HEIGHT_KINDS[0])
    if unknown := set(kinds) - {*HEIGHT_KINDS}:
        raise wrong(f"{name}, height_kind", min(unknown), " or ".join(HEIGHT_KINDS))
    if HEIGHT_KINDS[1] in kinds:
        height_m = height_m + (np.array(kinds) == HEIGHT_KINDS[1]) * egm96().undulation_m(lat, lon)
    times = column_of(rows, "time", name, utc_of)
    t_s = orbit.epoch.seconds_from_utc(times)
    if np.ptp(t_s) > ONE_INSTANT_S:
        raise wrong(f"{name}, time", f"instants {np.ptp(t_s):.3g} s apart", "one: a frame has one attitude")
    p_e = ecef_from_geodetic(lat, lon, height_m)
    try:
        u_i, range_m = apparent_ground_directions(p_e, t_s, orbit, orbit.earth, LightEffects())
    except ValueError as error:  # not covered by the orbit
        raise wrong(f"{name}, time", times[0], f"an instant of the orbit ({error})") from error
    above = np.sum((orbit.positions_e(t_s) - p_e) * unit_vectors(lon, lat), axis=1)
    if (above <= 0.0).any():
        n = int(np.argmin(above))
        where = f"a place {range_m[n] / 1e3:.0f} km off, below the horizon"
        raise wrong(f"{name}, row {n}", where, "one that the satellite sees: check lat_deg, lon_deg, time")
    sigma_m = np.column_stack([column(key, 0.0, 1e5, 0.0) for key in SIGMAS])
    axes_i = orbit.earth.matrices_ie(t_s) @ local_axes_e(lat, lon)
    covariance = (axes_i * sigma_m[:, None, :] ** 2) @ np.swapaxes(axes_i, 1, 2) / range_m[:, None, None] ** 2
    place = [
        "{!r}/{!r}/{!r}".format(*one) for one in zip(lat_deg.tolist(), lon_deg.tolist(), height_m.tolist())
    ]
    return SeenPlaces(u_i=u_i, covariance=covariance, place=np.array(place, dtype=str))
