"""Places on the ground as a satellite sees them, by astropy's frames: an outside authority."""

from pathlib import Path

import astropy.units as u
import numpy as np
import pandas as pd
from astropy.coordinates import GCRS, ITRS, CartesianRepresentation, EarthLocation
from astropy.time import Time
from astropy.utils import iers
from scipy.spatial.transform import Rotation
from wrong_vectors import R_TRUE, SIGMA_C, SIGMA_S, unit_vectors

__all__ = ["axes_of_gcrs", "directions_by_astropy", "frame_of", "ground_of", "places_below", "states_of"]

OMEGA_E, C = np.array([0.0, 0.0, 7.292115e-5]), 299792458.0  # rad/s, m/s
STATE = ("x_m", "y_m", "z_m", "vx_m_s", "vy_m_s", "vz_m_s")


def states_of(dump: Path) -> pd.DataFrame:
    """States of the satellite of a dump, ITRF, as `orbit=` takes them."""
    lines = [line.split() for line in (dump / "orbit.oem").read_text().splitlines() if line[:2] == "20"]
    return pd.DataFrame([[t, *(1e3 * float(x) for x in row)] for t, *row in lines], columns=["time", *STATE])


def places_below(states: pd.DataFrame, n: int, seed: int | None = None) -> pd.DataFrame:
    """Twelve places around the point below the satellite at its state `n`."""
    p = states.loc[n, ["x_m", "y_m", "z_m"]].to_numpy(float)
    lat, lon = np.degrees([np.arcsin(p[2] / np.linalg.norm(p)), np.arctan2(p[1], p[0])])
    off = np.random.default_rng(n if seed is None else seed).uniform(-0.15, 0.15, (12, 2))
    places = {"lat_deg": lat + off[:, 0], "lon_deg": lon + off[:, 1], "height_m": 100.0}
    return pd.DataFrame(places).assign(time=states["time"][n])


def axes_of_gcrs(t: Time) -> np.ndarray:
    """The matrix (3, 3) from ITRF to GCRF."""
    with iers.conf.set_temp("auto_download", False):
        axes = ITRS(CartesianRepresentation(np.eye(3) * u.km), obstime=t).transform_to(GCRS(obstime=t))
    return np.asarray(axes.cartesian.xyz.to_value(u.km))


def ground_of(table: pd.DataFrame) -> np.ndarray:
    """Places (N, 3), ITRF, m."""
    place = EarthLocation.from_geodetic(table["lon_deg"], table["lat_deg"], table["height_m"])
    return np.column_stack([one.to_value(u.m) for one in (place.x, place.y, place.z)])


def frame_of(v_targets: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Measured and known directions of 20 stars, and measured ones of targets (N, 3), of a frame that looks
    at them."""
    R_ci = Rotation.align_vectors([[0.0, 0.0, 1.0]], [v_targets.mean(axis=0)])[0]
    field = unit_vectors(np.column_stack([rng.uniform(-0.15, 0.15, (20, 2)), np.ones(20)]))
    u_s = unit_vectors(field + rng.normal(0.0, SIGMA_S, field.shape))
    w_c = unit_vectors(R_ci.apply(v_targets) + rng.normal(0.0, SIGMA_C, v_targets.shape))
    return u_s, R_ci.inv().apply(R_TRUE.apply(field)), w_c


def directions_by_astropy(
    states: pd.DataFrame, table: pd.DataFrame, moved_m: np.ndarray | float = 0.0
) -> np.ndarray:
    """Apparent directions (N, 3), GCRS, of places that are `moved_m` (N, 3), ITRF, off their tables: the
    Earth turned back over the light time, aberration to first order. Refraction 2 degrees from the nadir
    is left out, 0.2e-6 rad.
    """
    state = states[states["time"] == table["time"].iloc[0]].iloc[0]
    p_e, v_e = state.iloc[1:4].to_numpy(float), state.iloc[4:7].to_numpy(float)
    R_ie = axes_of_gcrs(Time(state["time"], scale="utc"))
    ground_e = ground_of(table) + moved_m
    late_s = np.linalg.norm(ground_e - p_e, axis=1)[:, None] / C
    plain = unit_vectors((ground_e - late_s * np.cross(OMEGA_E, ground_e) - p_e) @ R_ie.T)
    beta = R_ie @ (v_e + np.cross(OMEGA_E, p_e)) / C
    return unit_vectors(plain + beta - (plain @ beta)[:, None] * plain)
