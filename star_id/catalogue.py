"""The stars that are looked for: Hipparcos to V = 8, and which of them may be trusted to a fraction of an
arc-second.

Places and motions are van Leeuwen's (2007) where he gives any, magnitudes and the notes on multiplicity are
those of the ESA catalogue (1997); scripts/build_star_catalogue.py made the file and `catalogue_provenance`
returns its origin. Directions are left to `geometry.starlight`.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import NDArray

from boresight.geometry.constants import ARCSEC
from boresight.geometry.starlight import StarPlaces

__all__ = ["DISAGREEMENT_LIMIT_MAS", "CatalogueStars", "catalogue_provenance", "hipparcos_stars"]

_FILE = files("boresight.star_id") / "data" / "hipparcos_v8.npz"
Array = NDArray[np.float64]

DISAGREEMENT_LIMIT_MAS = 200.0  # two solutions of one star, carried to 2026: beyond it neither is believed
_EPOCH_JYEAR = 1991.25


@dataclass(frozen=True, slots=True, eq=False)
class CatalogueStars:
    """Stars of the catalogue in ascending order of HIP. Row n of every array speaks of the same star."""

    places: StarPlaces
    solved: NDArray[
        np.bool_
    ]  # (N,) van Leeuwen gives a solution; without one the place is good to about 0.1"
    disagreement_mas: Array  # (N,) between the two solutions, in 2026; NaN where one is missing
    multiplicity: NDArray[np.str_]  # (N,) ESA flag: C components, G acceleration, O orbit, V, X, or ''
    photocentre_shift_arcsec: Array  # (N,) from the catalogue's place to the light of an unresolved pair

    @property
    def usable_for_calibration(self) -> NDArray[np.bool_]:
        """(N,) the catalogue itself raises no doubt: solved, and both solutions agree."""
        return np.asarray(self.solved & (self.disagreement_mas <= DISAGREEMENT_LIMIT_MAS))

    def point_like(self, limit_arcsec: float) -> NDArray[np.bool_]:
        """(N,) the light of the star and its known companions stays within `limit_arcsec` of the place
        given."""
        return np.asarray(self.photocentre_shift_arcsec <= limit_arcsec)

    def take(self, index: NDArray) -> CatalogueStars:
        return CatalogueStars(
            self.places.take(index),
            self.solved[index],
            self.disagreement_mas[index],
            self.multiplicity[index],
            self.photocentre_shift_arcsec[index],
        )


def hipparcos_stars(max_v_mag: float = 8.0) -> CatalogueStars:
    """Stars no fainter than `max_v_mag` (Johnson V). The catalogue is complete to about 7.3 and ends at 8.0.

    A limit beyond 8 adds the one check star that the file carries (Barnard's star, V 9.54) and no other.
    """
    columns = _columns()
    keep = np.flatnonzero(columns["v_mag"].astype(float) <= max_v_mag + 1e-6)
    c = {name: values[keep] for name, values in columns.items()}
    dec = c["dec_rad"]
    places = StarPlaces(
        hip=c["hip"].astype(np.int64),
        ra_rad=c["ra_rad"],
        dec_rad=dec,
        pm_ra_rad_yr=c["pm_ra_cos_dec_mas_yr"].astype(float) * (1e-3 * ARCSEC) / np.cos(dec),
        pm_dec_rad_yr=c["pm_dec_mas_yr"].astype(float) * (1e-3 * ARCSEC),
        parallax_arcsec=np.maximum(c["parallax_mas"].astype(float), 0.0) * 1e-3,
        radial_velocity_km_s=np.zeros(len(dec)),
        v_mag=c["v_mag"].astype(float),
        b_v=c["b_v"].astype(float),
        epoch_jyear=_EPOCH_JYEAR,
    )
    return CatalogueStars(
        places, c["solved"], c["disagreement_mas"].astype(float), c["multiplicity"], _photocentre_shift(c)
    )


def catalogue_provenance() -> dict[str, Any]:
    """Where the file comes from: packages, checksums, citations, epoch, meaning of the columns."""
    with _FILE.open("rb") as stream, np.load(stream) as data:
        record: dict[str, Any] = json.loads(str(data["provenance"]))
    return record


@lru_cache(maxsize=1)
def _columns() -> dict[str, NDArray]:
    with _FILE.open("rb") as stream, np.load(stream) as data:
        return {name: data[name] for name in data.files if name != "provenance"}


def _photocentre_shift(columns: dict[str, NDArray]) -> Array:
    """How far the light of a pair lies from the component that the place speaks of, arc-seconds.

    A component at separation s and fainter by d magnitudes pulls by s / (1 + 10^(0.4 d)). Where the
    catalogue's place is the photocentre already (reference point '*') nothing is left but what the pair
    itself may move.
    """
    separation = columns["separation_arcsec"].astype(float)
    with np.errstate(invalid="ignore", over="ignore"):
        shift = separation / (1.0 + 10.0 ** (0.4 * np.abs(columns["delta_hp_mag"].astype(float))))
    shift[np.isnan(shift) | (columns["reference_point"] == "*")] = 0.0
    return shift
