"""Commands about the remote-sensing camera and the model of its strips: dimap, virtual-ccd,
remote-camera-calibrate.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from boresight.pipeline.console.arguments import DumpOption, SettingsFile
from boresight.pipeline.console.messages import Answer, print_data, say, talks, tell
from boresight.pipeline.files.object_store import dump_folder

__all__ = ["add_sensor_commands"]


def add_sensor_commands(app: typer.Typer) -> None:
    """Add the commands to the program."""
    app.command()(talks(dimap))
    app.command("virtual-ccd")(talks(virtual_ccd))
    app.command("remote-camera-calibrate")(talks(remote_camera_calibrate, with_json=True))


def dimap(
    product: Annotated[Path, typer.Argument(metavar="FILE", help="Pleiades metadata: DIM or PHRDIMAP XML.")],
    pixels: Annotated[Path | None, typer.Option(help="CSV file with the columns ccd, sample, line.")] = None,
    height_m: Annotated[float, typer.Option(help="Ellipsoidal height of the ground for --pixels.")] = 0.0,
    grid: Annotated[
        Path | None, typer.Option(help="Operator's location grid, GRID_*.tif, to compare.")
    ] = None,
) -> None:
    """Geolocate pixels of a Pleiades strip, or compare its model with the operator's location grid.

    Example: boresight dimap PHRDIMAP.XML --grid GRID.tif
    """
    from boresight.features.operators.dimap_grid import grid_differences, operator_model, places_of_pixels

    strip = operator_model(product)
    say(f"{strip.dataset}: {strip.width_px} x {strip.height_px} px")
    if pixels is not None:
        print_data("".join(places_of_pixels(strip, pixels, height_m)))
    if grid is not None:
        for altitude, rms, largest in grid_differences(strip, grid):
            tell(f"altitude {altitude:7.1f} m   rms {rms:.5f} m   largest {largest:.5f} m")


def virtual_ccd(
    result: Annotated[Path, typer.Argument(help="Folder that `calibrate` wrote.")],
    strip: Annotated[str, typer.Option(help="Id of the strip.")],
    out: Annotated[Path, typer.Option(help="GeoTIFF to write: float32 counts, NaN where no CCD looked.")],
    dump: DumpOption = None,
    height_m: Annotated[
        float | None, typer.Option(help="Ellipsoidal height to stitch at instead of the terrain model.")
    ] = None,
) -> None:
    """Stitch the CCDs of one strip to one ideal line (paper, section 3.1).

    Example: boresight virtual-ccd result --strip S01 --out S01.tif
    """
    from boresight.features.geolocate.virtual_strip import write_virtual_strip
    from boresight.geometry.terrain import ConstantHeight
    from boresight.pipeline.files.dump import surface_of
    from boresight.pipeline.results.strip_model import open_calibrated, strip_model

    calibrated = open_calibrated(result, dump)
    model = strip_model(calibrated, strip)
    surface = ConstantHeight(height_m) if height_m is not None else surface_of(calibrated.dump.terrain)
    lines, samples = write_virtual_strip(model, surface, out)
    tell(f"{strip}: {lines} lines, {samples} samples -> {out}")


def remote_camera_calibrate(
    sources: Annotated[
        list[Path],
        typer.Argument(
            metavar="RESULT|DUMP",
            parser=dump_folder,
            help="Dumps of one camera, or what `calibrate` made of them.",
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder for remote_camera.toml, interior.json and interior.png.")],
    settings: SettingsFile = None,
    curve_px: Annotated[
        float, typer.Option(help="Prior 1-sigma of the distortion that the table leaves, px.", min=1e-3)
    ] = 3.0,
    curve_length_px: Annotated[
        float, typer.Option(help="Length over which that distortion changes, px.", min=10.0)
    ] = 5000.0,
    shift_px: Annotated[float, typer.Option(help="Prior 1-sigma of the CCDs' places, px.", min=1e-3)] = 5.0,
    stagger_us: Annotated[
        float, typer.Option(help="Prior 1-sigma of the delay of a CCD's rows, µs; 0: none.", min=0.0)
    ] = 0.0,
) -> Answer:
    """Calibrate the interior of the remote-sensing camera in orbit, from strips of sky, ground or both.

    Example: boresight remote-camera-calibrate result --out camera
    """
    from boresight.calib.interior.parameters import InteriorPriors
    from boresight.features.interior.interior_files import interior_json, interior_lines, write_interior
    from boresight.features.interior.interior_of_dumps import calibrate_remote_camera
    from boresight.pipeline.console.progress import progress_bars
    from boresight.pipeline.run.executor import InOrder
    from boresight.pipeline.run.settings import read_settings

    priors = InteriorPriors(
        curve_px=curve_px, curve_length_px=curve_length_px, shift_px=shift_px, stagger_s=stagger_us * 1e-6
    )
    with progress_bars() as progress:
        found = calibrate_remote_camera(sources, read_settings(settings), priors, InOrder(), progress)
    files = write_interior(found, out)
    return Answer(
        text="\n".join([*interior_lines(found), f"-> {', '.join(str(path) for path in files)}"]),
        content=interior_json(found),
        files=files,
    )
