"""`boresight virtual-ccd`: the CCDs of one strip stitched to one ideal line."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from boresight.features.exports.ground_error import ground_error
from boresight.features.exports.virtual_strip import write_virtual_strip
from boresight.pipeline.console.arguments import CameraOption, DumpOption, option
from boresight.pipeline.console.completion import strips_of
from boresight.pipeline.console.messages import tell
from boresight.pipeline.files.terrain_files import surface_of
from boresight.pipeline.results.strip_model import open_calibrated, whole_strip_model

__all__ = ["virtual_ccd_command"]


def virtual_ccd_command(
    result: Annotated[Path, typer.Argument(help="Folder that `calibrate` wrote.")],
    strip: Annotated[str, typer.Option(help="Id of the strip.", autocompletion=strips_of)],
    out: Annotated[Path, typer.Option(help="GeoTIFF to write: float32 counts, NaN where no CCD looked.")],
    dump: DumpOption = None,
    camera: CameraOption = "",
    height_m: float | None = option("Ellipsoidal height to stitch at instead of the terrain model."),
) -> None:
    """Stitch the CCDs of one strip to one ideal line (paper, section 3.1), and write its RPC beside it.

    Example: boresight virtual-ccd result --strip S01 --out S01.tif
    """
    calibrated = open_calibrated(result, dump, camera=camera)
    model = whole_strip_model(calibrated, strip)
    surface = surface_of(calibrated.dump.terrain, height_m)
    middle_m = sum(surface.height_range_m()) / 2.0
    ccds = sorted(model.strip.ccd_lines.items())
    on_ground = ground_error(calibrated, model, *ccds[len(ccds) // 2], middle_m)
    lines, samples, error = write_virtual_strip(model, surface, out, on_ground)
    rpc = f"its RPC misses the virtual camera by up to {error.largest_px:.4f} px"
    tell(f"{strip}: {lines} lines, {samples} samples -> {out}; {rpc}")
