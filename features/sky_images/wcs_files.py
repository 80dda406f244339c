"""Write the FITS file that astronomy software reads: a TAN-SIP header and the identified stars."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.wcs import WCS

from boresight.features.sky_images.sip import TanSip, tan_sip
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.whole_file import write_whole
from boresight.star_id.field import FieldSolution

__all__ = ["SkyCoord", "image_wcs", "write_wcs"]


def write_wcs(path: Path, image: str, found: FieldSolution) -> None:
    """Write world coordinates of an image as a FITS header, and its identified stars as a table.

    Row 0 of the image is FITS row 1, so that viewers that draw row 1 at the bottom flip the image. All pixels
    are those of the image as it is, of a mirror image, too.
    `RawDataError` for a fisheye whose corners lie behind the camera.
    """
    wcs = tan_sip(found.camera, found.R_si, mirrored=found.mirrored)
    if not np.isfinite(wcs.largest_misfit_px):
        lens = "a fisheye whose corners lie behind the camera"
        raise RawDataError(image, "world coordinates", lens, "without --fits: it has no tangent plane")
    header = _header(wcs)
    header["NAXIS"] = 0
    header["IMAGEW"], header["IMAGEH"] = found.camera.width_px, found.camera.height_px
    header["SIPERR"] = (wcs.largest_misfit_px, "largest misfit of the polynomials, px")
    header["HISTORY"] = f"stars of {_ascii(Path(image).name)} identified by boresight"
    x, dx = found.xy_px[:, 0], found.residual_px[:, 0]
    if found.mirrored:
        x, dx = found.camera.width_px - 1.0 - x, -dx
    columns = [
        fits.Column("HIP", "J", array=found.hip),
        fits.Column("X_PX", "D", unit="pixel", array=x),
        fits.Column("Y_PX", "D", unit="pixel", array=found.xy_px[:, 1]),
        fits.Column("DX_PX", "D", unit="pixel", array=dx),
        fits.Column("DY_PX", "D", unit="pixel", array=found.residual_px[:, 1]),
    ]
    units = fits.HDUList(
        [fits.PrimaryHDU(header=header), fits.BinTableHDU.from_columns(columns, name="STARS")]
    )
    write_whole(path, lambda target: units.writeto(target, overwrite=True))


def image_wcs(found: TanSip, width_px: int, height_px: int) -> WCS:
    """The world coordinates as astropy's own, for an image of this size; its pixels count from 0."""
    header = _header(found)
    header["NAXIS"], header["NAXIS1"], header["NAXIS2"] = (2, width_px, height_px)
    return WCS(header)


def _header(found: TanSip) -> fits.Header:
    header = fits.Header()
    for key, value in found.cards().items():
        header[key] = value
    header["RADESYS"] = "ICRS"
    return header


def _ascii(text: str) -> str:
    """`text` with the characters that a FITS header cannot hold as escapes, at most 60 characters."""
    return ascii(text)[1:-1][:60]
