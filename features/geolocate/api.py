"""Where on the ground pixels of a calibrated strip look."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from boresight.features.geolocate.positions import Pixels
from boresight.features.geolocate.positions import geolocate as positions_of
from boresight.geometry.terrain import ConstantHeight
from boresight.pipeline.files.dump import surface_of
from boresight.pipeline.files.object_store import dump_folder
from boresight.pipeline.results.strip_model import open_calibrated, strip_model

__all__ = ["geolocate"]


def geolocate(
    result: str | Path,
    strip: str,
    ccd: ArrayLike,
    sample_px: ArrayLike,
    line_px: ArrayLike,
    *,
    dump: str | Path | None = None,
    height_m: float | None = None,
) -> pd.DataFrame:
    """Where on the ground pixels of a strip look, with 1-sigma along and across the track.

    Parameters
    ----------
    result : path
        A result folder.
    strip : str
        Id of the strip.
    ccd, sample_px, line_px : (N,) arrays or numbers
        CCD number from 0, and the image point; (0, 0) is the centre of the first pixel.
    dump : path, optional
        The dump; default: the one that the result names.
    height_m : float, optional
        Ellipsoidal height of the ground, m; default: the dump's terrain model.

    Returns
    -------
    pandas.DataFrame
        One row a pixel: lat_deg, lon_deg, height_m, sigma_along_m, sigma_across_m; NaN where the line of
        sight meets no known ground or the row has no attitude.

    Raises
    ------
    RawDataError
        If result or dump cannot be read or the strip is unknown.
    """
    calibrated = open_calibrated(Path(result), None if dump is None else dump_folder(dump))
    numbers = np.broadcast_arrays(*(np.atleast_1d(np.asarray(part)) for part in (ccd, sample_px, line_px)))
    pixels = Pixels(numbers[0].astype(np.int64), numbers[1].astype(float), numbers[2].astype(float))
    surface = surface_of(calibrated.dump.terrain) if height_m is None else ConstantHeight(height_m)
    found = positions_of(calibrated, strip_model(calibrated, strip), pixels, surface)
    columns = ("lat_deg", "lon_deg", "height_m", "sigma_along_m", "sigma_across_m")
    return pd.DataFrame({name: getattr(found, name) for name in columns})
