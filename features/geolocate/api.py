"""Where on the ground pixels of a calibrated strip look."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from boresight.accepted import PathLike, floats_of, number_of, path_of, source_of, wrong
from boresight.features.geolocate.positions import Pixels
from boresight.features.geolocate.positions import ground_places as positions_of
from boresight.pipeline.files.object_store import dump_folder
from boresight.pipeline.files.terrain_files import surface_of
from boresight.pipeline.results.strip_model import open_calibrated, strip_model

__all__ = ["geolocate"]


# Largest height of the ground, up or down, m, that may be asked for.
MOST_HEIGHT_M = 1e5


def geolocate(
    result: PathLike,
    strip: str,
    ccd: ArrayLike,
    line: ArrayLike,
    sample: ArrayLike,
    *,
    dump: PathLike | None = None,
    camera: str = "",
    height_m: float | None = None,
) -> pd.DataFrame:
    """Where on the ground pixels of a strip look, with 1-sigma along and across the track.

    Parameters
    ----------
    result : path or Calibration
        A result folder, or what `calibrate` returned.
    strip : str
        Id of the strip.
    ccd : (N,) array or number
        CCD number from 0.
    line, sample : (N,) arrays or numbers
        The image point, px; (0, 0) is the centre of the first pixel. Arrays and numbers are broadcast.
    dump : path, optional
        The dump; default: the one that the result names.
    camera : str
        Which camera, of a result of several.
    height_m : float, optional
        Ellipsoidal height of the ground, m; default: the dump's terrain model.

    Returns
    -------
    pandas.DataFrame
        One row a pixel: lat_deg, lon_deg, height_m, sigma_along_m, sigma_across_m; NaN where the line of
        sight meets no known ground, or the row lies outside the star exposures by more than half of the time
        from one to the next.

    Raises
    ------
    RawDataError
        If result or dump cannot be read, the strip is unknown or a pixel is outside its image.
    DataNotSufficientError
        If no two usable star exposures cover the strip.
    ValueError
        If an argument is not as described, or the result is from vectors.
    """
    if not isinstance(strip, str):
        raise wrong("strip", strip, "the id of a strip")
    if not isinstance(camera, str):
        raise wrong("camera", camera, "the id of a camera")
    folder = path_of(result, "result")
    place = None if dump is None else dump_folder(source_of(dump, "dump"))
    pixels = _pixels(ccd, line, sample)
    height = None if height_m is None else number_of(height_m, "height_m", -MOST_HEIGHT_M, MOST_HEIGHT_M)
    calibrated = open_calibrated(folder, place, camera=camera)
    surface = surface_of(calibrated.dump.terrain, height)
    found = positions_of(calibrated, strip_model(calibrated, strip), pixels, surface)
    columns = ("lat_deg", "lon_deg", "height_m", "sigma_along_m", "sigma_across_m")
    return pd.DataFrame({name: getattr(found, name) for name in columns})


def _pixels(ccd: ArrayLike, line: ArrayLike, sample: ArrayLike) -> Pixels:
    """Image points of broadcast arrays."""
    given = {"ccd": ccd, "line": line, "sample": sample}
    parts: dict[str, NDArray[Any]] = {}
    for name, value in given.items():
        parts[name] = np.atleast_1d(floats_of(value, name, "(N,)"))
        if parts[name].ndim != 1:
            raise wrong(name, parts[name], "a number or an array of shape (N,)")
        if not np.isfinite(parts[name]).all():
            raise wrong(name, "values that are not finite", "finite numbers")
    numbers = parts["ccd"]
    if (numbers != np.rint(numbers)).any() or (np.abs(numbers) > 2**31).any():
        raise wrong("ccd", float(numbers[0]), "whole numbers from 0")
    try:
        whole, at_line, at_sample = np.broadcast_arrays(*parts.values())
    except ValueError:
        lengths = ", ".join(f"{name} {len(part)}" for name, part in parts.items())
        raise wrong("ccd, line, sample", lengths, "arrays of one length, or numbers") from None
    return Pixels(whole.astype(np.int64), at_sample, at_line)
