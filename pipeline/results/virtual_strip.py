"""The CCDs of a strip stitched to the virtual CCD (paper, section 3.1), as a GeoTIFF without georeference."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import rasterio
from rasterio.windows import Window

from boresight.geometry.line_camera import LineCamera
from boresight.geometry.terrain import Surface
from boresight.geometry.virtual_ccd import VirtualStrip
from boresight.pipeline.errors import DataNotSufficientError
from boresight.pipeline.files.whole_file import write_whole
from boresight.pipeline.results.strip_model import StripModel

__all__ = ["write_virtual_strip"]

BLOCK_LINES = 512


def write_virtual_strip(model: StripModel, surface: Surface, out: Path) -> tuple[int, int]:
    """Write the stitched strip (float32 counts, NaN where no CCD saw the ground); its lines and samples.

    Raises `DataNotSufficientError` for a camera without a focal plane.
    """
    if not isinstance(model.pushbroom.camera, LineCamera):
        raise DataNotSufficientError("a virtual CCD needs a camera with focal length and focal plane")
    lines, images = model.strip.lines, model.strip.images
    n_lines = {ccd: images.shape(ccd)[0] for ccd in images.ccds}
    virtual = VirtualStrip(model.pushbroom.tabulated(0.0, lines - 1.0), surface)
    profile = {"driver": "GTiff", "width": virtual.width_px, "height": lines, "count": 1, "dtype": "float32"}

    def write(path: Path) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
            with rasterio.open(path, "w", **profile, nodata=np.nan, compress="deflate", predictor=3) as image:
                for top in range(0, lines, BLOCK_LINES):
                    bottom = min(top + BLOCK_LINES, lines)
                    part = virtual.stitched(images.read, n_lines, (top, bottom))
                    image.write(part, 1, window=Window(0, top, virtual.width_px, bottom - top))

    write_whole(out, write)
    return lines, virtual.width_px
