"""The files of one strip of the example as arguments of `dump_from_arrays`."""

from pathlib import Path

import numpy as np
import pandas as pd
import rasterio
from astropy.time import Time

import boresight as bs


def arrays_of(mini: Path) -> dict[str, object]:
    """Arguments of `dump_from_arrays` by name, of the first strip."""

    def read(file: str) -> tuple[np.ndarray, list[float], str]:
        with rasterio.open(mini / file) as one:
            return one.read(1), list(one.transform)[:6], str(one.crs)

    dump = bs.open_dump(mini)
    exposures = pd.read_csv(mini / "exposures.csv").iloc[:14].rename(columns={"utc_mid": "time"})
    strips = pd.read_csv(mini / "strips.csv").iloc[:4].rename(columns={"utc_first_row": "time"})
    targets = pd.read_csv(mini / "targets.csv").iloc[:12]
    chips = [read(file) for file in targets["chip"]]
    states = [line.split() for line in (mini / "orbit.oem").read_text().splitlines() if line[:2] == "20"]
    axes = ("x_m", "y_m", "z_m", "vx_m_s", "vy_m_s", "vz_m_s")
    return {
        "star_camera": dump.star_camera,
        "remote_camera": dump.line_camera,
        "R_cs0": dump.R_cs0.as_matrix(),
        "sigma_R_cs0_rad": 3e-3,
        "orbit": [
            {"time": Time(t, scale="utc"), **{axis: 1e3 * float(x) for axis, x in zip(axes, numbers)}}
            for t, *numbers in states
        ],
        "exposures": exposures.assign(image=[read(file)[0] for file in exposures["file"]]),
        "strips": strips.assign(image=[lambda file=file: read(file)[0] for file in strips["file"]]),
        "targets": targets.assign(
            chip=[one[0] for one in chips],
            chip_affine=[one[1] for one in chips],
            chip_crs=[one[2] for one in chips],
        ),
        "errors": {
            "position_m": 2.0,
            "clock_s": 1e-4,
            "vibration_arcsec": 0.1,
            "look_distortion_px": 0.03,
            "look_distortion_length_px": 125.0,
        },
        "terrain": read("terrain/dem.tif"),
        "terrain_height_kind": "egm96",
    }
