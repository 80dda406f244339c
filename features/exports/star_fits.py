"""Identified stars as a FITS binary table: one row per star of an exposure."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
from astropy.io import fits

from boresight.features.exports.notes import Notes, one_line
from boresight.geometry.epoch import Epoch
from boresight.geometry.sightings import StarSightings
from boresight.star_id.catalogue import hipparcos_stars

__all__ = ["centroids_fits"]


def centroids_fits(exposures: Sequence[StarSightings], epoch: Epoch, notes: Notes) -> bytes:
    """Bytes of the file, units in TUNIT. (0, 0) is the centre of the first pixel (FITS itself counts from 1).

    Characters that FITS cannot hold are replaced: control characters by a space, others by "?".
    """
    utc = epoch.utc_from_seconds([e.t_s for e in exposures]) if exposures else []
    counts = [len(e.hip) for e in exposures]

    def joined(name: str, *shape: int) -> np.ndarray:
        return np.concatenate([np.zeros((0, *shape)), *(getattr(e, name) for e in exposures)])

    u_i = joined("u_i", 3)
    sigma = np.sqrt(0.5 * np.einsum("naa->n", joined("cov_s", 3, 3)))
    snr = np.concatenate(
        [np.zeros(0), *(np.full(len(e.hip), np.nan) if e.snr is None else e.snr for e in exposures)]
    )
    hip = np.concatenate([np.zeros(0, dtype=np.int32), *(e.hip for e in exposures)]).astype(np.int32)
    columns = [
        fits.Column("EXPOSURE", "64A", array=np.repeat([_ascii(e.exposure_id) for e in exposures], counts)),
        fits.Column("UTC", "29A", array=np.repeat(utc, counts)),
        fits.Column("HIP", "J", array=hip),
        fits.Column("XY", "2D", unit="pixel", array=joined("xy_px", 2)),
        fits.Column("U_S", "3D", array=joined("u_s", 3)),
        fits.Column("U_I", "3D", array=u_i),
        fits.Column("RA", "D", unit="deg", array=np.degrees(np.arctan2(u_i[:, 1], u_i[:, 0])) % 360.0),
        fits.Column("DEC", "D", unit="deg", array=np.degrees(np.arcsin(np.clip(u_i[:, 2], -1.0, 1.0)))),
        fits.Column("SIGMA", "D", unit="rad", array=sigma),
        fits.Column("SNR", "D", array=snr),
        fits.Column("VMAG", "D", unit="mag", array=_magnitudes(hip)),
    ]
    table = fits.BinTableHDU.from_columns(columns, name="CENTROIDS")
    table.header["MISSION"] = _ascii(notes.mission)[:68]
    table.header["TIMESYS"] = "UTC"
    table.header["RADESYS"] = ("ICRS", "axes of RA, DEC and U_I; see COMMENT")
    table.header["DATE"] = (notes.created.rstrip("Z"), "UTC of the export")
    for line in notes.lines():
        table.header["HISTORY"] = _ascii(line)
    for text in (
        "XY: column and row as measured, (0, 0) is the centre of the first pixel; distortion not removed.",
        "U_S: direction in the star camera, distortion removed. U_I: apparent direction in GCRS,",
        "aberration included (that of RA, DEC). SIGMA: of a direction, rms of its two axes.",
        "SNR: of the detection, NaN where not known. VMAG: Johnson V of the catalogue.",
    ):
        table.header["COMMENT"] = text
    out = io.BytesIO()
    fits.HDUList([fits.PrimaryHDU(), table]).writeto(out)
    return out.getvalue()


def _magnitudes(hip: np.ndarray) -> np.ndarray:
    """Johnson V (N,) of Hipparcos numbers (N,); NaN for others."""
    places = hipparcos_stars(np.inf).places
    at = np.minimum(np.searchsorted(places.hip, hip), len(places.hip) - 1)
    return np.where(places.hip[at] == hip, places.v_mag[at], np.nan)


def _ascii(text: str) -> str:
    return one_line(text).encode("ascii", "replace").decode()
