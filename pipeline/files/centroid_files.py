"""Read lists of centroids, one row a star, as `boresight centroids --out` writes them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.text_files import check_number, csv_rows
from boresight.star_id.centroids import Centroids

__all__ = ["read_centroids"]

# Columns of a list of centroids.
NUMBERS = ("x_px", "y_px", "sigma_x_px", "sigma_y_px", "cov_xy_px2", "flux_dn")
OPTIONAL = ("snr", "saturated", "blended", "psf_sigma_px")
TRUTHS = {"true": True, "1": True, "false": False, "0": False}  # texts of a truth value, in lower case
# Largest place of a centroid, px, that can be one: no detector is wider.
LIMIT_PX = 1e6
USUAL_PSF_PX = 1.0  # where the list does not state its width


def read_centroids(path: Path, file: str) -> dict[str, Centroids]:
    """The centroids of each image by its name (column `file`); `RawDataError` for an invalid file."""
    rows: dict[str, list[list[float]]] = {}
    for line, row in csv_rows(path, ("file", *NUMBERS), OPTIONAL, file):
        name = row["file"].strip()
        values = [check_number(row[key], file, f"{line}, {key}") for key in NUMBERS]
        if (blended := row.get("blended", "0").strip().lower()) not in TRUTHS:
            raise RawDataError(file, f"{line}, blended", blended, "0, 1, true or false")
        snr = check_number(row["snr"], file, f"{line}, snr") if "snr" in row else np.nan
        psf = check_number(row.get("psf_sigma_px", str(USUAL_PSF_PX)), file, f"{line}, psf_sigma_px")
        x, y, sigma_x, sigma_y, covariance, flux = values
        if not (abs(x) < LIMIT_PX and abs(y) < LIMIT_PX and 0.0 < psf < 100.0 and abs(flux) < 1e18):
            found, expected = f"{x}, {y}, {flux}, {psf}", "positions within 1e6 px, a PSF below 100 px"
            raise RawDataError(file, line, found, expected)
        good = all(1e-6 < sigma < 1e3 for sigma in (sigma_x, sigma_y))
        if not (good and abs(covariance) < 0.999_999 * sigma_x * sigma_y):
            found = f"{sigma_x}, {sigma_y}, covariance {covariance}"
            expected = "1e-6 to 1e3 px, correlated by less than 1"
            raise RawDataError(file, f"{line}, sigma_x_px", found, expected)
        rows.setdefault(name, []).append([*values, float(TRUTHS[blended]), psf, snr])
    return {name: _centroids(np.array(values)) for name, values in rows.items()}


def _centroids(values: np.ndarray) -> Centroids:
    brightest_first = np.argsort(-values[:, 5], kind="stable")
    x, y, sigma_x, sigma_y, covariance, _, blended, psf, snr = values[brightest_first].T
    cov_px = np.empty((len(x), 2, 2))
    cov_px[:, 0, 0], cov_px[:, 1, 1] = sigma_x**2, sigma_y**2
    cov_px[:, 0, 1] = cov_px[:, 1, 0] = covariance
    return Centroids(
        xy_px=np.column_stack([x, y]),
        cov_px=cov_px,
        blended=blended > 0.5,
        snr=snr,
        psf_sigma_px=float(np.median(psf)),
    )
