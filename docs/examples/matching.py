"""A user of the matcher: one array found in another, then the targets of a whole strip.

The first picture is a chip of the example "mini"; the second one shows the same ground moved by a known
fraction of a pixel, in other light and with noise. Then the targets of one raw strip are measured, starting
from the pre-launch installation matrix, which is wrong by hundreds of pixels.
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import rasterio
from scipy.ndimage import fourier_shift, gaussian_filter

import boresight as bs

FIXTURE = bs.example("mini")
PICTURES = Path(sys.argv[1] if len(sys.argv) > 1 else ".")

with rasterio.open(FIXTURE / "chips" / "s01-t05.tif") as file:
    ground = gaussian_filter(file.read(1).astype(float), 1.0)
rng = np.random.default_rng(1)

# Two arrays: the template is cut at a known place; the picture is moved by (0.30, -0.45) px.
moved = np.fft.ifft2(fourier_shift(np.fft.fft2(ground), (-0.45, 0.30))).real
picture = 0.6 * moved + 40.0 + rng.normal(0.0, 2.0, ground.shape)
middle = np.array(ground.shape[::-1]) // 2
template = ground[middle[1] - 32 : middle[1] + 32, middle[0] - 32 : middle[0] + 32]
match = bs.match_template(template, picture, start_px=(middle[0] + 3, middle[1] - 2))
if not match:
    sys.exit(match.sentence)
print(match)
error_px = match.xy_px - (middle - 0.5 + [0.30, -0.45])
sigma_px = np.sqrt(np.diag(match.cov_px))
print(
    f"error ({error_px[0]:+.3f}, {error_px[1]:+.3f}) px, 1 sigma ({sigma_px[0]:.3f}, {sigma_px[1]:.3f}) px\n"
)

# What cannot be found is not invented: the ground upside down.
nothing = bs.match_template(template[::-1], picture, start_px=(middle[0], middle[1]))
print("upside down:", "found" if nothing else nothing.sentence, "\n")

# A strip: attitudes from the star images, targets predicted, searched, measured.
matches = bs.match_targets(FIXTURE, strips=["s01"])
print(matches)
columns = ["target_id", "ccd", "sample_px", "line_px", "sigma_sample_px", "sigma_line_px"]
print(matches.table()[columns].head(4).round(3).to_string(index=False))

figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 3.8), layout="constrained")
match.plot(left)
matches.plot(right)
right.set_title("targets of strip s01")
figure.savefig(PICTURES / "example_matching.png", dpi=110)
