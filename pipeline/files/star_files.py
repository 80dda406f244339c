"""Files that other astronomy software reads: a TAN-SIP header with the named stars."""

from __future__ import annotations

from pathlib import Path

from boresight.pipeline.files.whole_file import write_whole
from boresight.star_id.field import FieldSolution
from boresight.star_id.sip import tan_sip

__all__ = ["write_wcs"]


def write_wcs(path: Path, image: str, found: FieldSolution) -> None:
    """FITS file whose primary header is the image's world coordinates and whose table lists the named stars.

    Row 0 of the image is FITS row 1; a program that shows FITS images from the bottom up shows it upside
    down.
    """
    from astropy.io import fits

    wcs = tan_sip(found.camera, found.R_si)
    header = fits.Header()
    for key, value in wcs.cards().items():
        header[key] = value
    header["NAXIS"] = 0
    header["IMAGEW"], header["IMAGEH"] = found.camera.width_px, found.camera.height_px
    header["RADESYS"] = "ICRS"
    header["SIPERR"] = (wcs.largest_misfit_px, "largest misfit of the polynomials, px")
    header["HISTORY"] = f"stars of {Path(image).name} named by boresight"
    columns = [
        fits.Column("HIP", "J", array=found.hip),
        fits.Column("X_PX", "D", unit="pixel", array=found.xy_px[:, 0]),
        fits.Column("Y_PX", "D", unit="pixel", array=found.xy_px[:, 1]),
        fits.Column("DX_PX", "D", unit="pixel", array=found.residual_px[:, 0]),
        fits.Column("DY_PX", "D", unit="pixel", array=found.residual_px[:, 1]),
    ]
    units = fits.HDUList(
        [fits.PrimaryHDU(header=header), fits.BinTableHDU.from_columns(columns, name="STARS")]
    )
    write_whole(path, lambda target: units.writeto(target, overwrite=True))
