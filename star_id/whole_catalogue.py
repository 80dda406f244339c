"""All 117 955 stars of the new Hipparcos reduction (van Leeuwen 2007) with their errors, for sky strips.

The remote-sensing camera sees few stars to V = 8 at a time, so fainter ones are needed, and its pixels are as
small as a catalogue's error after thirty years. Beyond V = 8 Hipparcos is not complete: it lists half of the
stars of V 8 to 9, a tenth of V 9 to 10, one in a hundred of V 10 to 11.
scripts/build_star_catalogue.py made the file and describes its columns.
"""

from __future__ import annotations

from functools import lru_cache
from importlib.resources import files

import numpy as np
from numpy.typing import NDArray

from boresight.geometry.constants import ARCSEC
from boresight.geometry.starlight import StarPlaces, SurveyedStars
from boresight.records.record import Floats
from boresight.star_id.catalogue import EPOCH_JYEAR

__all__ = ["all_hipparcos"]

# All of Hipparcos, packed by scripts/build_star_catalogue.py.
_FILE = files("boresight.star_id") / "data" / "hipparcos_all.npz"
# One milliarc-second, rad.
_MAS = 1e-3 * ARCSEC


@lru_cache(maxsize=1)
def all_hipparcos() -> SurveyedStars:
    """All stars of the catalogue in ascending order of HIP; positions to 0.2 mas, V to 0.01."""
    with _FILE.open("rb") as stream, np.load(stream) as data:
        c = {name: data[name] for name in data.files}
    dec = _summed(c["dec"], np.int32) * (np.pi / 2**32)
    places = StarPlaces(
        hip=c["hip"].astype(np.int64),
        ra_rad=_summed(c["ra"], np.uint32) * (2.0 * np.pi / 2**32),
        dec_rad=dec,
        pm_ra_rad_yr=_summed(c["pm_ra"], np.int32) * (0.1 * _MAS) / np.cos(dec),
        pm_dec_rad_yr=_summed(c["pm_dec"], np.int32) * (0.1 * _MAS),
        parallax_arcsec=c["parallax"] * 1e-4,
        radial_velocity_km_s=np.zeros(len(dec)),
        v_mag=c["v_mag"] * 0.01,
        b_v=c["b_v"] * 0.01,
        epoch_jyear=EPOCH_JYEAR,
    )
    return SurveyedStars(
        name="HIP",
        places=places,
        sigma_rad=_sigma(c["sigma"]),
        sigma_pm_rad_yr=_sigma(c["sigma_pm"]),
        single=c["single"],
    )


def _summed(planes: NDArray[np.uint8], kind: type[np.int32] | type[np.uint32]) -> Floats:
    """Numbers (N,) of 32 bits from the bytes (4, N) of their differences."""
    steps = np.ascontiguousarray(planes.T).view("<u4")[:, 0].astype(np.uint32)
    return np.cumsum(steps, dtype=np.uint32).view(kind).astype(np.float64)


def _sigma(code: NDArray[np.uint8]) -> Floats:
    return 0.05 * _MAS * 2.0 ** (code / 16.0)
