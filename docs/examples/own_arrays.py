"""An operator with arrays of his own: tables and images in memory in, matrix and coordinates out.

The arrays are those of the example "mini", where yours come from your own reader: states of the orbit in
metres, counts of star images and strips, targets with chips of orthophotos, a terrain model. The image of a
strip is a function, called when the image is needed: one at a time is in memory.
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import rasterio
from PIL import Image

import boresight as bs

FIXTURE = bs.example("mini")
PICTURES = Path(sys.argv[1] if len(sys.argv) > 1 else ".")


def map_of(file):
    with rasterio.open(FIXTURE / file) as one:
        return one.read(1), list(one.transform), str(one.crs)


axes = ["x_m", "y_m", "z_m", "vx_m_s", "vy_m_s", "vz_m_s"]
orbit = pd.read_csv(FIXTURE / "orbit.oem", sep=" ", skiprows=15, names=["time", *axes])
orbit[axes] *= 1000.0  # from kilometres
exposures = pd.read_csv(FIXTURE / "exposures.csv").rename(columns={"utc_mid": "time"})
exposures["image"] = [np.asarray(Image.open(FIXTURE / file)) for file in exposures["file"]]
strips = pd.read_csv(FIXTURE / "strips.csv").rename(columns={"utc_first_row": "time"})
strips["image"] = [lambda path=FIXTURE / file: np.asarray(Image.open(path)) for file in strips["file"]]
targets = pd.read_csv(FIXTURE / "targets.csv")
targets["chip"], targets["chip_affine"], targets["chip_crs"] = zip(*map(map_of, targets["chip"]))
tables = {"orbit": orbit, "exposures": exposures, "strips": strips, "targets": targets}
terrain = {"terrain": map_of("terrain/dem.tif"), "terrain_height_kind": "egm96"}

own = bs.open_dump(FIXTURE)  # for its cameras; yours are a StarCamera and a LineCamera or LookAngleCamera
cameras = {"star_camera": own.star_camera, "remote_camera": own.line_camera, "R_cs0": own.R_cs0.as_matrix()}
errors = {"position_m": 2.0, "clock_s": 1e-4, "vibration_arcsec": 0.1}
errors |= {"look_distortion_px": 0.03, "look_distortion_length_px": 125.0}
dump = bs.dump_from_arrays(**cameras, sigma_R_cs0_rad=3e-3, **tables, **terrain, errors=errors)
result = bs.calibrate(dump)

# Where pixels of strip s02 look, held against places that the simulator knows.
known = pd.read_csv(FIXTURE / "truth" / "check_points.csv").query("strip == 's02'").reset_index()
places = result.geolocate("s02", known["ccd"], known["line"], known["sample"], dump=dump)
print(result, places.head(3).round(6).to_string(index=False), sep="\n\n", end="\n\n")
error_m = (places - known)[["lon_deg", "lat_deg"]] * [91.4e3, 111.2e3]  # metres a degree, 34.8 deg north
print(f"{len(known)} check points: rms error {np.sqrt((error_m**2).to_numpy().sum(axis=1).mean()):.1f} m")

figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 4.0), layout="constrained")
result.plot(left)
right.quiver(*places[["lon_deg", "lat_deg"]].T.to_numpy(), *error_m.T.to_numpy(), scale=60.0)
right.set(xticks=[102.58, 102.64, 102.7], title="errors by longitude and latitude; width: 60 m")
figure.savefig(PICTURES / "example_own_arrays.png", dpi=110)
