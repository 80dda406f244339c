"""Values printed in the paper's section 3: Tables 1 to 5 (4 and 5: single draws) and the text."""

from __future__ import annotations

from math import sqrt

__all__ = [
    "FIGURES_5_6_Z_ARCSEC",
    "FIGURE_7_CELLS",
    "FIGURE_7_MEAN_ARCSEC",
    "FIGURE_7_SIGMA_ARCSEC",
    "TABLE_1_GROUND_M",
    "TABLE_2",
    "TABLE_3",
    "TABLE_3_DISTORTION_UM",
    "TABLE_4",
    "TABLE_4_RMS_ARCSEC",
    "TABLE_5",
    "TEXT_VALUES",
]

# The header of Table 1 is shifted by a row; the clock's acts along the orbit only
TABLE_1_GROUND_M = {"GPS": 2.0, "vibration": 0.25, "clock": 0.75, "distortion": 0.21}

# mm, degrees, Hz, px, um; the four numbers of the distortion are printed without names and units
TABLE_2 = {
    "focal length": 100.0,
    "field of view in x": 18.0,
    "field of view in y": 14.0,
    "data rate": 5.0,
    "principal point x": 2560.0,
    "principal point y": 1920.0,
    "pixel": 6.4,
    "p1": 2.29e-5,
    "p2": -2.96e-5,
    "q1": -9.30e-7,
    "q2": -4.25e-9,
}

# m, px; of the distortion three samples are printed with a value: the principal point has none by definition
TABLE_3 = {"focal length": 10.0, "pixels of a CCD": 6144.0, "pixel": 1e-5, "principal point": 3067.0}
TABLE_3_DISTORTION_UM = {56.0: 1077.2, 203.0: 866.3, 3067.0: 0.0}  # by sample

TEXT_VALUES = {  # sections 3.1 and 3.3.2
    "resolution along the orbit": 0.5,
    "offset by 1250 km of elevation": 0.5,
    "star camera at 0.05 px, 3 sigma": 0.5,
}

# (sigma_s px, sigma_c px): Wang's X, Y, Z and the paper's X, Y, Z, arcsec
TABLE_4: dict[tuple[float, float], tuple[tuple[float, float, float], tuple[float, float, float]]] = {
    (0.06, 0.3): ((0.3198, -0.5958, -7.4917), (0.0383, 0.0202, -0.2788)),
    (0.07, 0.5): ((0.3644, -0.6686, 4.4221), (-0.0640, -0.0464, -0.5072)),
    (0.08, 0.5): ((0.1656, -0.7332, 4.7857), (-0.0809, -0.0441, -0.1987)),
    (0.09, 0.7): ((0.5519, -0.6898, -8.4521), (-0.0064, 0.0038, -0.6839)),
    (0.10, 1.0): ((0.1837, -0.7338, -9.6278), (0.0121, 0.0135, 0.6246)),
}

TABLE_4_RMS_ARCSEC = {  # over its five rows, X, Y, Z
    who: tuple(sqrt(sum(row[n][axis] ** 2 for row in TABLE_4.values()) / len(TABLE_4)) for axis in range(3))
    for n, who in enumerate(("wang", "paper"))
}

# sigma_s px (sigma_c is 0.3 px; the last is printed as 0.010): along Wang, paper; across Wang, paper, metres
TABLE_5: dict[float, tuple[float, float, float, float]] = {
    0.050: (5.96, 4.32, 5.17, 3.54),
    0.055: (6.65, 4.41, 5.56, 3.64),
    0.060: (6.31, 4.53, 5.82, 3.77),
    0.065: (6.97, 4.71, 6.20, 3.87),
    0.070: (7.39, 4.92, 6.24, 4.15),
    0.075: (7.25, 4.98, 6.46, 4.18),
    0.080: (7.73, 5.12, 6.84, 4.31),
    0.085: (8.02, 5.18, 7.18, 4.34),
    0.090: (8.13, 5.29, 7.16, 4.49),
    0.095: (8.39, 5.38, 8.57, 4.53),
    0.100: (9.23, 5.29, 8.11, 4.48),
}

# text on Figs. 5 and 6, (sigma_s px, sigma_c px): Z error after convergence; X and Y "tend to 0" by 150
# frames
FIGURES_5_6_Z_ARCSEC = {(0.06, 0.1): 0.2, (0.10, 1.0): 0.5}

FIGURE_7_CELLS = tuple((s / 100.0, c / 10.0) for s in range(5, 11) for c in range(1, 11))  # of our grid, px
FIGURE_7_MEAN_ARCSEC = (-0.0018, -0.0001, -0.2602)  # over the paper's grid, X, Y, Z
FIGURE_7_SIGMA_ARCSEC = (0.0159, 0.0105, 0.0927)  # standard deviation over the paper's grid
