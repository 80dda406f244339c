"""The CSV of the matrix holds the numbers of installation.json, bit for bit."""

import csv
import io

import numpy as np
import pytest
from orbiting_camera import NOTES
from scipy.spatial.transform import Rotation

from boresight.features.exports.matrix_csv import matrix_csv

R_CS = Rotation.from_euler("xyz", [40.0, -65.0, 110.0], degrees=True)
INSTALLATION = {
    "R_cs": R_CS.as_matrix().tolist(),
    "quaternion": R_CS.as_quat().tolist(),
    "theta_rad": [0.003, 0.002 / 3.0, -0.001],
    "euler_zxy_deg": [0.17, 0.03, -0.05],
    "covariance_rad2": (1e-14 * np.array([[2.0, 0.1, 0.2], [0.1, 3.0, 0.3], [0.2, 0.3, 4.0]])).tolist(),
    "settings": {"left": "out"},
}


def numbers(text):
    """Values by name, without the notes at the end."""
    rows = {row["name"]: row["value"] for row in csv.DictReader(io.StringIO(text))}
    assert [rows.pop(name) for name in NOTES.items()] == list(NOTES.items().values())
    return {name: float(value) for name, value in rows.items()}


def test_csv_holds_the_same_numbers():
    rows = numbers(matrix_csv(INSTALLATION, NOTES))
    matrix = [[rows[f"R_cs_{i}{j}"] for j in "xyz"] for i in "xyz"]
    assert matrix == INSTALLATION["R_cs"]
    assert [rows[f"q_{k}"] for k in "xyzw"] == INSTALLATION["quaternion"]
    assert [rows[f"theta_{k}_rad"] for k in "xyz"] == INSTALLATION["theta_rad"]
    assert [rows[f"euler_{k}_deg"] for k in "xyz"] == INSTALLATION["euler_zxy_deg"]
    assert [[rows[f"cov_{i}{j}_rad2"] for j in "xyz"] for i in "xyz"] == INSTALLATION["covariance_rad2"]
    assert len(rows) == 28


def test_the_matrix_in_the_csv_turns_star_vectors_into_the_camera():
    rows = numbers(matrix_csv(INSTALLATION, NOTES))
    u_c = [sum(rows[f"R_cs_{i}{j}"] * u for j, u in zip("xyz", (0.6, 0.0, 0.8))) for i in "xyz"]
    assert u_c == pytest.approx(R_CS.apply([0.6, 0.0, 0.8]), abs=1e-15)
