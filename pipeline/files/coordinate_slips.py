"""Coordinates that contradict a target's chip, and the slip that would put them right.

A chip shows the ground around its target. Where the target lies outside, its coordinates may have been
mistyped, or its chip is that of another target.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise

import numpy as np

from boresight.gct_match.records import Target
from boresight.geometry.geodesy import ecef_from_geodetic, geodetic_from_ecef, local_axes_e
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.ground_points import ChipFile
from boresight.pipeline.files.images.rasters import GridPlace, grid_place
from boresight.records.record import Bools, Floats, record, scalar

__all__ = ["contradiction", "likeliest", "slips"]

# Decimals of latitude and longitude, degrees, in messages: 1e-7 degree is a centimetre on the ground.
DECIMALS = 7
MOST_CHIPS = 200  # that are looked at for the one of which a target is


@record
class Slip:
    """Coordinates as they may have been meant."""

    lat_deg: float = scalar("latitude, °")
    lon_deg: float = scalar("longitude, °")
    words: str = scalar('what would have to be read: "lon_deg 102.91 for 102.19 (digits exchanged)"')
    kind: str = scalar('the same without the values: "lon_deg (digits exchanged)"')


def slips(lat_deg: float, lon_deg: float) -> list[Slip]:
    """Coordinates that one slip turns into (`lat_deg`, `lon_deg`), °, the commonest kinds first: neighbouring
    digits exchanged, a sign, latitude and longitude exchanged, one digit wrong.
    """
    lat, lon = f"{lat_deg:.{DECIMALS}f}", f"{lon_deg:.{DECIMALS}f}"
    found = []
    for kind, change in (("digits exchanged", _exchanged), ("sign", _negated), ("one digit", _one_digit)):
        if kind == "one digit":
            both = "lat_deg and lon_deg exchanged"
            found.append(Slip(lon_deg, lat_deg, both, both))
        for meant in change(lat):
            words = _words("lat_deg", meant, lat, kind)
            found.append(Slip(float(meant), lon_deg, words, f"lat_deg ({kind})"))
        for meant in change(lon):
            words = _words("lon_deg", meant, lon, kind)
            found.append(Slip(lat_deg, float(meant), words, f"lon_deg ({kind})"))
    return [one for one in found if abs(one.lat_deg) <= 90.0 and -180.0 <= one.lon_deg <= 360.0]


def likeliest(candidates: Sequence[Slip], fits: Callable[[Floats], Bools]) -> Slip | None:
    """The first of some slips whose places (N, 2), latitude and longitude in °, fit; None where none does."""
    places = np.array([[one.lat_deg, one.lon_deg] for one in candidates])
    return next((one for one, good in zip(candidates, fits(places).tolist()) if good), None)


def contradiction(target: Target, chip: ChipFile, others: Sequence[ChipFile]) -> tuple[str, str]:
    """How a target's coordinates contradict its chip, with what would put them right, and the kind of slip
    that does (`Slip.kind`); empty where they lie in it, or it cannot be read. `others` are the chips of all
    targets.
    """
    place = _place(chip)
    lat, lon, _ = np.degrees(geodetic_from_ecef(target.p_e[None]))
    here = np.column_stack([lat, lon])
    if place is None or place.contains(here)[0]:
        return "", ""
    if slip := likeliest(slips(*here[0].tolist()), place.contains):
        return f"{slip.words} would lie in its chip; correct targets.csv", slip.kind
    for other in others[:MOST_CHIPS]:
        if other.file != chip.file and (theirs := _place(other)) and theirs.contains(here)[0]:
            text = f"not in {chip.file} but in {other.file}, the chip of {other.target_id}: correct the files"
            return text, ""
    lat, lon = np.radians(np.vstack([here, place.middle_deg])).T
    one, other = ecef_from_geodetic(lat, lon, np.zeros(2))
    apart_km = 1e-3 * float(np.linalg.norm(one - other))
    return f"{apart_km:.3g} km from the middle of its chip; correct its coordinates or chip", ""


def off_middle_m(target: Target, chip: ChipFile) -> tuple[float, float]:
    """How far a target's coordinates lie east and north of the middle of its chip, m; NaN: unreadable."""
    if (place := _place(chip)) is None:
        return np.nan, np.nan
    lat, lon = np.radians(np.array([place.middle_deg], dtype=float)).T
    lat_target, lon_target, _ = geodetic_from_ecef(target.p_e[None])
    there = ecef_from_geodetic(lat, lon, np.zeros(1))
    here = ecef_from_geodetic(lat_target, lon_target, np.zeros(1))
    east_m, north_m = (local_axes_e(lat, lon)[0].T @ (here - there)[0])[:2].tolist()
    return east_m, north_m


def _place(chip: ChipFile) -> GridPlace | None:
    try:
        return grid_place(chip.path, chip.file)
    except RawDataError:
        return None


def _words(name: str, meant: str, stated: str, kind: str) -> str:
    """Both values, cut after the last digit in which they differ, at least two after the point."""
    if len(meant) != len(stated):
        return f"{name} {float(meant):g} for {float(stated):g} ({kind})"
    differ = max(n for n, (a, b) in enumerate(zip(meant, stated)) if a != b)
    end = max(differ + 1, stated.index(".") + 3)
    return f"{name} {meant[:end]} for {stated[:end]} ({kind})"


def _exchanged(text: str) -> Iterator[str]:
    for a, b in pairwise(n for n, c in enumerate(text) if c.isdigit()):
        if text[a] != text[b]:
            yield text[:a] + text[b] + text[a + 1 : b] + text[a] + text[b + 1 :]


def _negated(text: str) -> Iterator[str]:
    yield text[1:] if text.startswith("-") else f"-{text}"


def _one_digit(text: str) -> Iterator[str]:
    for n, old in enumerate(text):
        for new in "0123456789" if old.isdigit() else "":
            if new != old:
                yield text[:n] + new + text[n + 1 :]
