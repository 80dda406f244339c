"""`boresight remote-camera-calibrate`: the interior orientation in orbit."""

from __future__ import annotations

from pathlib import Path

from boresight.features.interior.interior_files import interior_json, interior_lines, write_interior
from boresight.features.interior.interior_of_dumps import calibrate_remote_camera
from boresight.features.interior.interior_parameters import InteriorPriors
from boresight.pipeline.console.arguments import SettingsFile, argument, option
from boresight.pipeline.console.messages import Answer
from boresight.pipeline.console.progress import progress_bars
from boresight.pipeline.files.object_store import dump_folder
from boresight.pipeline.run.executor import InOrder
from boresight.pipeline.run.settings import read_settings

__all__ = ["remote_camera_calibrate_command"]


def remote_camera_calibrate_command(
    sources: list[Path] = argument(
        "Dumps of one camera, or what `calibrate` made of them.", metavar="RESULT|DUMP", parser=dump_folder
    ),
    out: Path = option("Folder for remote_camera.toml, interior.json and interior.png.", ...),
    settings: SettingsFile = None,
    curve_px: float = option("Prior 1-sigma of the distortion that the table leaves, px.", 3.0, min=1e-3),
    curve_length_px: float = option("Length over which that distortion changes, px.", 5000.0, min=10.0),
    shift_px: float = option("Prior 1-sigma of the CCDs' places, px.", 5.0, min=1e-3),
    stagger_us: float = option("Prior 1-sigma of the delay of a CCD's rows, µs; 0: none.", 0.0, min=0.0),
) -> Answer:
    """Calibrate the interior of the remote-sensing camera in orbit, from strips of sky, ground or both.

    Example: boresight remote-camera-calibrate result --out camera
    """
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
