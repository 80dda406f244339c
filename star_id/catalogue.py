"""Star catalogue: Hipparcos to V = 8, with the reliability of each position to a fraction of an arc-second.

Positions and proper motions are van Leeuwen's (2007) where available; magnitudes and multiplicity flags are
those of the ESA catalogue (1997). scripts/build_star_catalogue.py made the file; its column `provenance`
states its origin. Directions are computed by `geometry.starlight`.
"""

from __future__ import annotations

from functools import lru_cache
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import NDArray

from boresight.geometry.constants import ARCSEC
from boresight.geometry.starlight import StarPlaces
from boresight.records.record import Bools, Floats, array, record, scalar

__all__ = ["DISAGREEMENT_LIMIT_MAS", "EPOCH_JYEAR", "CatalogueStars", "hipparcos_stars"]

# Stars of Hipparcos to V 8, written by scripts/build_star_catalogue.py.
_FILE = files("boresight.star_id") / "data" / "hipparcos_v8.npz"

# Largest distance, mas, in 2026 between the places that the two Hipparcos reductions give for a star:
# beyond it neither is used for calibration (set by hand; such stars are mostly double).
DISAGREEMENT_LIMIT_MAS = 200.0
# Epoch of the places in the Hipparcos catalogue, Julian year (ESA SP-1200, 1997).
EPOCH_JYEAR = 1991.25


@record
class CatalogueStars:
    """Stars of the catalogue in ascending order of HIP. Row n of every array is the same star."""

    places: StarPlaces = scalar("positions, proper motions and magnitudes")
    solved: Bools = array("N", "whether van Leeuwen gives a solution; else the error is about 0.1 arcsec")
    disagreement_mas: Floats = array("N", "between the two solutions in 2026, mas; NaN if one is missing")
    photocentre_shift_arcsec: Floats = array("N", "from the position to an unresolved pair's photocentre")

    @property
    def usable_for_calibration(self) -> Bools:
        """(N,) whether the star is solved and both solutions agree."""
        return np.asarray(self.solved & (self.disagreement_mas <= DISAGREEMENT_LIMIT_MAS))

    def point_like(self, limit_arcsec: float) -> Bools:
        """(N,) whether the photocentre with known companions is within `limit_arcsec` of the position."""
        return np.asarray(self.photocentre_shift_arcsec <= limit_arcsec)


@lru_cache(maxsize=4)
def hipparcos_stars(max_v_mag: float = 8.0) -> CatalogueStars:
    """Catalogue stars up to magnitude `max_v_mag` (Johnson V); complete to about 7.3, ends at 8.0.

    A limit beyond 8 adds only the check star of the file (Barnard's star, V 9.54).
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
        epoch_jyear=EPOCH_JYEAR,
    )
    return CatalogueStars(places, c["solved"], c["disagreement_mas"].astype(float), _photocentre_shift(c))


@lru_cache(maxsize=1)
def _columns() -> dict[str, NDArray[Any]]:
    with _FILE.open("rb") as stream, np.load(stream) as data:
        return {name: data[name] for name in data.files if name != "provenance"}


def _photocentre_shift(columns: dict[str, NDArray[Any]]) -> Floats:
    """(N,) distance of a pair's photocentre from the component that the position refers to, arcsec.

    A component at separation s and fainter by d magnitudes shifts it by s / (1 + 10^(0.4 d)). If the position
    is the photocentre (reference point '*') the shift is zero.
    """
    separation = columns["separation_arcsec"].astype(float)
    with np.errstate(invalid="ignore", over="ignore"):
        shift = separation / (1.0 + 10.0 ** (0.4 * np.abs(columns["delta_hp_mag"].astype(float))))
    shift[np.isnan(shift) | (columns["reference_point"] == "*")] = 0.0
    return shift
