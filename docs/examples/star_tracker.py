"""A star-tracker developer: find stars, identify them, calibrate the lens.

The images are the first ten exposures of the example "mini". Nothing is known of the camera but that its
field is about 20 degrees wide. At the end the lens is compared with the one that the images were rendered
with.
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import pandas as pd

import boresight as bs

FIXTURE = bs.example("mini")
PICTURES = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
images = [FIXTURE / "exposures" / f"e{number:04d}.png" for number in range(1, 11)]

# Find: centroids with covariances, brightest first.
stars = bs.find_stars(images[0])
print(stars, "\n")
print(stars.table().head(3).round(3).to_string(index=False), "\n")

# Identify: no attitude is given. An image that cannot be identified gives a false result with a reason.
solution = bs.identify(stars, fov_deg=20)
if not solution:
    sys.exit(solution.reason)
print(solution, "\n")

# Calibrate the lens: one camera for all images, one attitude each. With the times the Earth's aberration is
# removed, which would change the focal length by 0.3 px.
times = pd.read_csv(FIXTURE / "exposures.csv")["utc_mid"].head(len(images)).tolist()
lens = bs.calibrate_star_camera(images, fov_deg=solution.fov_deg, times=times)
if not lens:
    sys.exit(lens.reason)
print(lens, "\n")

# With the lens known, the attitude of a single image is better.
better = bs.identify(stars, camera=lens.camera, time=times[0])
assert better
sigmas = f"{solution.sigma_arcsec[0]:.2f} arcsec alone, {better.sigma_arcsec[0]:.2f} with the lens"
print("pointing, 1 sigma:", sigmas)

true = bs.open_dump(FIXTURE).star_camera
error_px = lens.camera.focal_m / lens.camera.pixel_m - true.focal_m / true.pixel_m
print(f"focal length: error {error_px:+.3f} px, 1 sigma {lens.sigma_focal_px:.3f} px")

figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 3.6), layout="constrained")
better.plot(left, image=plt.imread(images[0]))
left.set(xlim=(300, 620), ylim=(420, 180), title="identified stars, Hipparcos numbers")
lens.plot(right)
figure.savefig(PICTURES / "example_star_tracker.png", dpi=110)
