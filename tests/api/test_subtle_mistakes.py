"""Subtle mistakes of convention, unit, frame, time, order and repetition: none is wrong in silence.

Each is refused by name, refutes the result, is warned of, is named among the vectors that are not used, or is
an error that `blind_spots` names.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation
from seen_by_astropy import states_of
from wrong_vectors import R_TRUE, SIGMA_C, SIGMA_S, Given, drawn_vectors, nees_of, unit_vectors

import boresight as bs

ARCSEC = np.pi / 648000.0
Change = Callable[[Given], Given]
MOST_NEES = 21.1  # chi-square, 3 degrees of freedom, 1 in 10 000


def each(name: str, change: Callable[[np.ndarray], Any]) -> Change:
    return lambda given: given._replace(**{name: [change(part) for part in getattr(given, name)]})


def put(**values: Any) -> Change:
    return lambda given: given._replace(**values)


def first(given: Given) -> Given:
    """One frame alone."""
    return Given(*(part[:1] if isinstance(part, list) else part for part in given))


def turned(axis: str, deg: float) -> Rotation:
    return Rotation.from_euler(axis, deg, degrees=True)


def moved_by(velocity: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Aberration to first order by a velocity over that of light."""
    return lambda v: unit_vectors(v + velocity)


def shifted(parts: list[np.ndarray]) -> list[np.ndarray]:
    return [*parts[1:], parts[0]]


def all_twice(given: Given, off: float = 0.0) -> Given:
    return given._replace(
        u_s=[*given.u_s, *(part + off for part in given.u_s)],
        w_c=[*given.w_c, *(part + off for part in given.w_c)],
        v_stars=given.v_stars * 2,
        v_targets=given.v_targets * 2,
    )


def rows_twice(given: Given, off: float = 0.0) -> Given:
    doubled = {n: [np.vstack([p, p + off]) for p in getattr(given, n)] for n in ("u_s", "w_c")}
    known = {n: [np.vstack([p, p]) for p in getattr(given, n)] for n in ("v_stars", "v_targets")}
    return given._replace(**doubled, **known)


def precessed(given: Given) -> Given:
    """Stars in axes of date, 26 years of precession from those of the targets."""
    return each("v_stars", turned("z", 0.36).apply)(given)


MISTAKES: dict[str, tuple[Change, str]] = {
    # conventions
    "both signs of w_c": (each("w_c", lambda w: w * [-1, -1, 1]), "refused"),
    "the sign of x of w_c": (each("w_c", lambda w: w * [-1, 1, 1]), "refused"),
    "the sign of y of w_c": (each("w_c", lambda w: w * [1, -1, 1]), "refused"),
    "the sign of z of w_c": (each("w_c", lambda w: w * [1, 1, -1]), "refused"),
    "x and y of w_c exchanged": (each("w_c", lambda w: w[:, [1, 0, 2]]), "refused or refuted"),
    "w_c a quarter off about z": (each("w_c", turned("z", 90).apply), "refused"),
    "both signs of u_s": (each("u_s", lambda v: v * [-1, -1, 1]), "refused"),
    "u_s mirrored": (each("u_s", lambda v: v * [-1, 1, 1]), "refused"),
    "R_cs0 inverted": (lambda g: g._replace(R_cs0=g.R_cs0.inv()), "refused"),
    "R_cs0 180 degrees about z off": (lambda g: g._replace(R_cs0=turned("z", 180) * g.R_cs0), "refused"),
    "R_cs0 thirty degrees about z off": (lambda g: g._replace(R_cs0=turned("z", 30) * g.R_cs0), "refused"),
    "R_cs0 of a quaternion with its scalar first": (
        put(R_cs0=Rotation.from_quat(np.roll(R_TRUE.as_quat(), 1))),
        "refused",
    ),
    "R_cs0 a reflection": (put(R_cs0=R_TRUE.as_matrix() * [[1.0], [1.0], [-1.0]]), "refused"),
    "v_targets from the ground upwards": (each("v_targets", np.negative), "refused"),
    # frames
    "w_c in frame s": (each("w_c", R_TRUE.inv().apply), "refused"),
    "v_targets in frame c": (lambda g: g._replace(v_targets=g.w_c), "refused"),
    "v_targets in frame s": (
        lambda g: g._replace(v_targets=[R_TRUE.inv().apply(w) for w in g.w_c]),
        "refused",
    ),
    "stars in axes of date": (precessed, "refuted"),
    "stars in axes of date, one frame": (lambda g: precessed(first(g)), "blind"),
    "stars without the annual aberration": (each("v_stars", moved_by(np.array([1e-4, 0, 0]))), "refuted"),
    "targets without aberration, one frame": (
        lambda g: each("v_targets", moved_by(np.array([2.5e-5, 0, 0])))(first(g)),
        "blind",
    ),
    "targets a second late, one frame": (
        lambda g: each("v_targets", Rotation.from_rotvec([0, 1e-3, 0]).apply)(first(g)),
        "blind",
    ),
    # units
    "sigma_s in arcseconds": (put(sigma_s=SIGMA_S / ARCSEC), "refused"),
    "sigma_c in arcseconds": (put(sigma_c=SIGMA_C / ARCSEC), "refused"),
    "sigma_s in degrees": (put(sigma_s=np.degrees(SIGMA_S)), "warned"),
    "sigma_c in degrees": (put(sigma_c=np.degrees(SIGMA_C)), "warned"),
    "sigma_s in microradians": (put(sigma_s=SIGMA_S * 1e6), "refused"),
    "sigma_s a variance": (put(sigma_s=SIGMA_S**2), "refused"),
    "sigma_s ten times too small": (put(sigma_s=SIGMA_S / 10), "refused or refuted"),
    "sigma_c ten times too small": (put(sigma_c=SIGMA_C / 10), "refuted"),
    "u_s as tangents of the field": (each("u_s", lambda v: v / v[:, 2:]), "refused"),
    "u_s in pixels": (each("u_s", lambda v: 1e4 * v), "refused"),
    "u_s by a focal length that is a thousandth too long": (
        each("u_s", lambda v: unit_vectors(v * [0.999, 0.999, 1.0])),
        "refused or refuted",
    ),
    # order
    "stars of other frames": (lambda g: g._replace(v_stars=shifted(g.v_stars)), "refused"),
    "targets of other frames": (lambda g: g._replace(v_targets=shifted(g.v_targets)), "refused"),
    "rows of v_stars reversed": (each("v_stars", lambda v: v[::-1]), "refused"),
    "rows of v_targets reversed": (each("v_targets", lambda v: v[::-1]), "refused or refuted"),
    "two stars exchanged": (
        lambda g: g._replace(v_stars=[g.v_stars[0][[1, 0, *range(2, 20)]], *g.v_stars[1:]]),
        "named",
    ),
    "two targets exchanged": (
        lambda g: g._replace(v_targets=[g.v_targets[0][[1, 0, *range(2, 20)]], *g.v_targets[1:]]),
        "named",
    ),
    # repetition
    "all frames twice": (all_twice, "refused"),
    "all frames twice, by rounding apart": (lambda g: all_twice(g, 1e-9), "refused"),
    "all rows twice": (rows_twice, "refused"),
    "all rows twice, by rounding apart": (lambda g: rows_twice(g, 1e-9), "refused"),
}


def what_came(given: Given, **more: Any) -> str:
    """What a caller learns."""
    try:
        found = bs.calibrate_vectors(*given, **more)
    except (ValueError, bs.DataNotSufficientError):
        return "refused"
    if found.verdict == "refuted":
        return "refuted"
    if len(found.findings) or "smaller than stated" in repr(found):
        return "warned"
    if len(found.not_used) and nees_of(found.R_cs, found.cov_theta) < MOST_NEES:
        return "named"
    unseen = found.blind_spots.query("is_unseen")["cause"]
    return "blind" if unseen.str.contains("aberration").any() else "silent"


@pytest.mark.parametrize("name", MISTAKES)
def test_a_subtle_mistake_is_not_wrong_in_silence(name: str) -> None:
    change, expected = MISTAKES[name]
    assert what_came(change(drawn_vectors(np.random.default_rng(41), frames=3))) in expected


def test_there_are_forty_mistakes_and_right_vectors_are_none() -> None:
    assert len(MISTAKES) >= 40
    given = drawn_vectors(np.random.default_rng(41), frames=3)
    found = bs.calibrate_vectors(*given)
    assert found.verdict == "consistent" and nees_of(found.R_cs, found.cov_theta) < MOST_NEES


@pytest.fixture(scope="module")
def states(finished: tuple[Path, Path]) -> pd.DataFrame:
    return states_of(finished[0])


@pytest.mark.parametrize(
    ("of_states", "of_places", "message"),
    [
        ({"km": True}, {}, "orbit"),
        ({"frame": "GCRF"}, {}, "orbit"),
        ({}, {"swap": True}, "below the horizon|lat_deg"),
        ({}, {"sign": True}, "below the horizon"),
        ({}, {"radians": True}, "below the horizon"),
        ({}, {"hours": 8}, "an instant of the orbit"),
        ({}, {"spread": 0.5}, "a frame has one attitude"),
        ({}, {"height": 9500.0}, "height_m"),
    ],
)
def test_a_mistake_in_places_or_orbit_is_named(
    states: pd.DataFrame, of_states: dict[str, Any], of_places: dict[str, Any], message: str
) -> None:
    row = states.iloc[60]
    p = row[["x_m", "y_m", "z_m"]].to_numpy(float)
    lat, lon = np.degrees([np.arcsin(p[2] / np.linalg.norm(p)), np.arctan2(p[1], p[0])])
    place = {"lat_deg": lat, "lon_deg": lon, "height_m": of_places.get("height", 100.0)}
    if "swap" in of_places:
        place |= {"lat_deg": lon, "lon_deg": lat}
    if "sign" in of_places:
        place["lon_deg"] = -lon
    if "radians" in of_places:
        place |= {"lat_deg": np.radians(lat), "lon_deg": np.radians(lon)}
    t = pd.Timestamp(row["time"]) + pd.Timedelta(hours=of_places.get("hours", 0))
    times = t + pd.to_timedelta(np.linspace(0.0, of_places.get("spread", 0.0), 20), unit="s")
    given = drawn_vectors(np.random.default_rng(42))
    table = pd.DataFrame([place] * 20).assign(time=times)
    orbit = states.assign(**{n: states[n] / 1e3 for n in states.columns[1:]}) if "km" in of_states else states
    with pytest.raises(ValueError, match=message):
        bs.calibrate_vectors(
            *given._replace(v_targets=[table]), orbit=orbit, orbit_frame=of_states.get("frame", "ITRF")
        )
