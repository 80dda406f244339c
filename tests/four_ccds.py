"""Four staggered and rotated CCDs of 6144 px behind 10 m, for tests and benchmarks."""

from collections.abc import Mapping

from numpy.typing import NDArray

from boresight.geometry.line_camera import Ccd


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
