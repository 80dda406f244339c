"""A researcher: vectors in, matrix and covariance out; the paper's Fig. 5.

Each frame has one unknown attitude, 30 stars and 10 targets, with the noise of the paper: 0.06 px of the star
camera, 0.1 px of the remote-sensing camera. The error of the installation matrix falls with the number of
frames, and the stated 1 sigma with it.
"""

import sys

import matplotlib.pyplot as plt
import numpy as np
from scipy.spatial.transform import Rotation

import boresight as bs

rng = np.random.default_rng(2020)
sigma_s, sigma_c = 0.06 * 6.4e-5, 0.1 * 1e-6  # rad: parts of a pixel
R_true = Rotation.from_rotvec([np.radians(165.0), 0.0, 0.0])  # the star camera looks 15 deg off the zenith


def drawn(n, half_x, half_y, sigma, R_ci):
    """Directions over a field, tangents of half its width and height: measured, and known in GCRS."""
    tangents = rng.uniform(-1.0, 1.0, (n, 2)) * [half_x, half_y]
    u = np.column_stack([tangents, np.ones(n)]) / np.sqrt(1.0 + np.sum(tangents**2, axis=1))[:, None]
    measured = u + rng.normal(0.0, sigma, u.shape)
    return measured / np.linalg.norm(measured, axis=1, keepdims=True), R_ci.inv().apply(u)


attitudes = Rotation.random(150, random_state=rng)
u_s, v_stars = zip(*(drawn(30, 0.164, 0.123, sigma_s, R_si) for R_si in attitudes))
w_c, v_targets = zip(*(drawn(10, 0.0, 0.0123, sigma_c, R_true * R_si) for R_si in attitudes))
R_start = Rotation.from_rotvec([-0.003, -0.002, -0.001]) * R_true  # the paper's (28)

counts = np.unique(np.geomspace(2, 150, 10).astype(int))
estimates = [
    bs.calibrate_vectors(u_s[:n], v_stars[:n], sigma_s, w_c[:n], v_targets[:n], sigma_c, R_start)
    for n in counts
]
errors = np.array([-(est.R_cs * R_true.inv()).as_rotvec(degrees=True) * 3600.0 for est in estimates])
sigmas = np.array([est.sigma_arcsec for est in estimates])

last, error = estimates[-1], np.radians(errors[-1] / 3600.0)
print(last, last.table().round(4).to_string(index=False), sep="\n\n", end="\n\n")
print("error, arcsec:", *(f"{value:+.4f}" for value in errors[-1]))
print(f"NEES {error @ np.linalg.solve(last.cov_theta, error):.2f} (3 is expected)")

figure, axes = plt.subplots(1, 3, figsize=(9.0, 3.0), layout="constrained", sharex=True)
for axis, name in enumerate("XYZ"):
    axes[axis].plot(counts, errors[:, axis], "k.-", label="error")
    axes[axis].fill_between(counts, -sigmas[:, axis], sigmas[:, axis], color="0.8", label="1 sigma stated")
    axes[axis].set(xscale="log", xlabel="frames", title=f"about {name}")
    axes[axis].set_ylim(np.array([-4, 4]) * sigmas[2, axis])
axes[0].set_ylabel("arcsec")
axes[2].legend()
figure.savefig(f"{sys.argv[1] if len(sys.argv) > 1 else '.'}/example_vectors.png", dpi=110)
