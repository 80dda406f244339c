"""Four staggered and rotated CCDs of 6144 px behind 10 m, and the difference of two cameras, for tests and
benchmarks.
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from boresight.geometry.line_camera import Ccd, LineCamera
from boresight.records.record import Floats


def four_ccds(tables: list[Mapping[str, NDArray]]) -> tuple[Ccd, ...]:
    """The CCDs, overlapping by 100 px; `tables` has the distortion fields of each, as of a laboratory."""
    return tuple(
        Ccd(
            n_px=6144,
            y_first_m=-0.122 + k * 0.06044,
            x_offset_m=0.004 * (-1) ** k,
            rotation_rad=1e-4 * (k - 1.5),
            pixel_m=1e-5,
            principal_sample=3067.0,
            **table,
        )
        for k, table in enumerate(tables)
    )


def map_difference_px(one: LineCamera, other: LineCamera, samples_each: int = 200) -> tuple[Floats, Floats]:
    """Difference (J, 2) of two cameras' look directions along x and y of frame c, px, less the small rotation
    that belongs to the installation matrix; and (J, 2) the CCD and sample of each row.
    """
    rows, fields, differences = [], [], []
    for c, ccd in enumerate(one.ccds):
        sample = np.linspace(0.0, ccd.n_px - 1.0, samples_each)
        u = other.directions_from_pixels(c, sample)
        rows.append(np.column_stack([np.full(samples_each, c), sample]))
        differences.append(one.directions_from_pixels(c, sample) - u)
        fields.append(np.cross(np.eye(3)[None], u[:, None]))  # (J, 3 axes, 3)
    difference, field = np.concatenate(differences), np.concatenate(fields)
    X = np.swapaxes(field, 1, 2).reshape(-1, 3)
    turn, *_ = np.linalg.lstsq(X, difference.ravel(), rcond=None)
    left = difference - (X @ turn).reshape(-1, 3)
    return left[:, :2] / one.pixel_rad, np.concatenate(rows)
