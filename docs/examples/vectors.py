"""A researcher: vectors in, matrix and covariance out; the paper's Fig. 5 in twenty lines.

Each frame has one unknown attitude, 30 stars and 10 targets, with the noise of the paper: 0.06 px of the star
camera, 0.1 px of the remote-sensing camera. The error of the installation matrix falls with the number of
frames, and the stated 1 sigma with it.
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from scipy.spatial.transform import Rotation

import boresight as bs
from boresight.simulator.campaign import CameraPair, draw_frames, installation_by_tilt

PICTURES = Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parents[1] / "images")

R_true = installation_by_tilt(np.radians(15.0))
drawn = draw_frames(150, 30, 10, 0.06, 0.1, CameraPair(R_true), np.random.default_rng(5))
u_s, v_stars, sigma_s, w_c, v_targets, sigma_c = zip(*(drawn.frame(k) for k in range(len(drawn))))
R_start = Rotation.from_rotvec([-0.003, -0.002, -0.001]) * R_true  # the paper's (28)

counts = np.unique(np.geomspace(2, 150, 10).astype(int))
estimates = [
    bs.calibrate_vectors(u_s[:n], v_stars[:n], sigma_s[:n], w_c[:n], v_targets[:n], sigma_c[:n], R_start)
    for n in counts
]
errors = np.array([-(est.R_cs * R_true.inv()).as_rotvec(degrees=True) * 3600.0 for est in estimates])
sigmas = np.array([est.sigma_arcsec for est in estimates])

last = estimates[-1]
print(last, "\n")
print(last.table().round(4).to_string(index=False), "\n")
error = np.radians(errors[-1] / 3600.0)
print("error, arcsec:", *(f"{value:+.4f}" for value in errors[-1]))
print(f"NEES {error @ np.linalg.solve(last.cov_theta, error):.2f} (3 is expected)")

figure, axes = plt.subplots(1, 3, figsize=(9.0, 3.0), layout="constrained", sharex=True)
for axis, name in enumerate("XYZ"):
    axes[axis].plot(counts, errors[:, axis], "k.-", label="error")
    axes[axis].fill_between(counts, -sigmas[:, axis], sigmas[:, axis], color="0.8", label="1 sigma stated")
    axes[axis].set(
        xscale="log", xlabel="frames", title=f"about {name}", ylim=np.array([-4, 4]) * sigmas[2, axis]
    )
axes[0].set_ylabel("arcsec")
axes[2].legend()
figure.savefig(PICTURES / "example_vectors.png", dpi=110)
