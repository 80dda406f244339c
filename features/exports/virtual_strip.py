"""The CCDs of a strip stitched to the virtual CCD (paper, section 3.1), as a GeoTIFF with places on the
ground and an RPC.

The virtual camera has a smooth attitude and equal steps of time between lines, so that an RPC describes it.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import rasterio
from rasterio.control import GroundControlPoint
from rasterio.rpc import RPC
from rasterio.windows import Window

from boresight.features.exports.ground_error import GroundError
from boresight.features.exports.rpc import RpcError, fit_rpc, rpc_heights, rpc_metadata, rpc_text
from boresight.features.exports.virtual_ccd import VirtualStrip
from boresight.geometry.geodesy import geodetic_from_ecef
from boresight.geometry.line_camera import LookAngleCamera
from boresight.geometry.terrain import Surface
from boresight.pipeline.errors import DataNotSufficientError
from boresight.pipeline.files.images.tiff import tiff_opened
from boresight.pipeline.files.whole_file import write_text, write_whole
from boresight.pipeline.results.strip_model import StripModel

__all__ = ["write_virtual_strip"]

# Lines of the stitched image that are made at a time, which bounds memory.
BLOCK_LINES = 512
CONTROL = (17, 9)  # lines and samples of the lattice of ground control points


def write_virtual_strip(
    model: StripModel, surface: Surface, out: Path, on_ground: GroundError
) -> tuple[int, int, RpcError]:
    """Write the stitched strip (float32 counts, NaN where no CCD saw the ground); its lines, samples, and the
    error of its RPC.

    `on_ground` is the error that the RPC states. A lattice of pixels has its places on the surface as ground
    control points. The RPC is in the tags of the file and in NAME_RPC.TXT. Raises `DataNotSufficientError`
    for a strip without images.
    """
    lines, images = model.strip.lines, model.strip.images
    if not images.ccds:
        raise DataNotSufficientError(f"strip {model.strip.strip_id}: the dump has no images to stitch")
    n_lines = {ccd: images.shape(ccd)[0] for ccd in images.ccds}
    pushbroom = model.pushbroom
    if isinstance(pushbroom.camera, LookAngleCamera):
        pushbroom = replace(pushbroom, camera=pushbroom.camera.with_focal_plane())
    smooth = -0.5, lines - 0.5
    virtual = VirtualStrip(pushbroom.tabulated(0.0, lines - 1.0), surface, smooth_rows=smooth)
    rpc, error = fit_rpc(virtual.virtual, 0, lines, rpc_heights(surface))
    control = _control_points(virtual, lines)

    def write(path: Path) -> None:
        how = {"nodata": np.nan, "compress": "deflate", "predictor": 3}
        with tiff_opened(path, (lines, virtual.width_px), "float32", **how) as image:
            if control:
                image.gcps = control, rasterio.CRS.from_epsg(4979)
            image.rpcs = RPC.from_gdal(rpc_metadata(rpc, on_ground))
            for top in range(0, lines, BLOCK_LINES):
                bottom = min(top + BLOCK_LINES, lines)
                part = virtual.stitched(images.read, n_lines, (top, bottom))
                image.write(part, 1, window=Window(0, top, virtual.width_px, bottom - top))

    write_whole(out, write)
    write_text(out.with_name(f"{out.stem}_RPC.TXT"), rpc_text(rpc, on_ground))
    return lines, virtual.width_px, error


def _control_points(virtual: VirtualStrip, lines: int) -> list[GroundControlPoint]:
    """Places of a lattice of virtual pixels; GDAL counts from the outer corner of the first pixel."""
    ends = (lines - 1.0, virtual.width_px - 1.0)
    axes = [np.linspace(0.0, end, n, dtype=np.float64) for end, n in zip(ends, CONTROL)]
    line, sample = (grid.ravel() for grid in np.meshgrid(*axes, indexing="ij"))
    p_e = virtual.virtual.ground_points(0, sample, line, virtual.surface)
    lat, lon, height = geodetic_from_ecef(p_e)
    return [
        GroundControlPoint(
            row=float(line[n]) + 0.5,
            col=float(sample[n]) + 0.5,
            x=float(np.degrees(lon[n])),
            y=float(np.degrees(lat[n])),
            z=float(height[n]),
            id=str(n),
        )
        for n in np.flatnonzero(np.isfinite(p_e).all(axis=1)).tolist()
    ]
