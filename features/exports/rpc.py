"""Rational polynomial coefficients (RPC00B) of one CCD of a strip, fitted to the rigorous model.

    sample = N_s(lat, lon, height) / D_s(...)     line = N_l / D_l     all quantities offset and scaled

Each polynomial is a cubic of 20 terms, each denominator begins with 1 (NIMA STDI-0006). The 39 coefficients
of a coordinate are those of smallest norm that solve the linearised equations; each equation is divided by
the denominator of the pass before. Small singular values are not used: fitted to motion that no cubic follows
they give denominators with zeros. Of several limits the one with the smallest error at other points is taken.
"""

from __future__ import annotations

import numpy as np

from boresight.features.exports.ground_error import GroundError
from boresight.geometry.geodesy import geodetic_from_ecef
from boresight.geometry.pushbroom import Pushbroom
from boresight.geometry.terrain import ConstantHeight, Surface
from boresight.records.record import Floats, array, record, scalar

__all__ = ["Rpc", "RpcError", "fit_rpc", "rpc_heights", "rpc_metadata", "rpc_text"]

GRID = (25, 25, 7)  # samples, lines, heights of the fit
CUTS = (1e-3, 1e-4, 1e-5, 1e-6, 1e-8)  # of the largest singular value
LEAST_DENOMINATOR = 0.3  # of 1 in the middle: below, a zero may lie between the points of the fit
# Points, and heights among them, at which the fitted RPC is compared with the rigorous model.
CHECK_POINTS, CHECK_HEIGHTS = 1000, 40
MARGIN_M = 100.0  # heights below and above the terrain for which an RPC is fitted
POLYNOMIALS = ("LINE_NUM", "LINE_DEN", "SAMP_NUM", "SAMP_DEN")  # in GDAL's names


@record(kw_only=True)
class Rpc:
    """An RPC. Image points are (sample, line), (0, 0) the centre of the first pixel."""

    offsets: Floats = array("5", "of line, sample (px), latitude, longitude (degrees), height (m)")
    scales: Floats = array("5", "of the same")
    line_num: Floats = array("20", "coefficients of RPC00B's order")
    line_den: Floats = array("20", "the first is 1")
    sample_num: Floats = array("20", "coefficients of RPC00B's order")
    sample_den: Floats = array("20", "the first is 1")

    def pixels(self, lat_deg: Floats, lon_deg: Floats, height_m: Floats) -> tuple[Floats, Floats]:
        """Sample and line (N,) of ground points (N,)."""
        ground = np.stack([lat_deg, lon_deg, height_m])
        terms = _terms(*((ground - self.offsets[2:, None]) / self.scales[2:, None]))
        line = terms @ self.line_num / (terms @ self.line_den)
        sample = terms @ self.sample_num / (terms @ self.sample_den)
        return sample * self.scales[1] + self.offsets[1], line * self.scales[0] + self.offsets[0]


@record(kw_only=True)
class RpcError:
    """Difference of an RPC from the rigorous model at random image points and heights, px."""

    rms_px: float = scalar("root mean square of the distance, px")
    largest_px: float = scalar("largest distance, px")


def fit_rpc(model: Pushbroom, ccd: int, lines: int, height_m: tuple[float, float]) -> tuple[Rpc, RpcError]:
    """The RPC of the image of a CCD, of `lines` lines, for ellipsoidal heights from `height_m[0]` to
    `height_m[1]`, and its difference from the rigorous model at random points between these.

    Raises `ValueError` where the model has no ground for a point of the strip.
    """
    samples = model.camera.n_px(ccd)
    axes = [np.linspace(-0.5, n - 0.5, count) for n, count in zip((samples, lines), GRID)]
    grid = np.meshgrid(*axes, np.linspace(*height_m, GRID[2]), indexing="ij")
    sample, line, height = (part.ravel() for part in grid)
    lat, lon = _ground(model, ccd, sample, line, height)
    values = np.stack([line, sample, lat, lon, height])
    low, high = values.min(axis=1), values.max(axis=1)
    offsets, scales = 0.5 * (low + high), np.maximum(0.5 * (high - low), 1e-9)
    line_n, sample_n, *ground = (values - offsets[:, None]) / scales[:, None]
    terms = _terms(*ground)
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.5, np.array([samples, lines]) - 0.5, (CHECK_POINTS, 2))
    heights = np.resize(rng.uniform(*height_m, CHECK_HEIGHTS), CHECK_POINTS)
    check = *_ground(model, ccd, points[:, 0], points[:, 1], heights), heights
    fits = []
    for cut in CUTS:
        (line_num, line_den), (sample_num, sample_den) = (_ratio(terms, n, cut) for n in (line_n, sample_n))
        rpc = Rpc(
            offsets=offsets,
            scales=scales,
            line_num=line_num,
            line_den=line_den,
            sample_num=sample_num,
            sample_den=sample_den,
        )
        least = min(float((terms @ den).min()) for den in (line_den, sample_den))
        if least >= LEAST_DENOMINATOR or cut == CUTS[0]:
            fits.append((rpc, _difference(rpc, check, points)))
    return min(fits, key=lambda fit: fit[1].largest_px)


def rpc_heights(surface: Surface) -> tuple[float, float]:
    """Heights from below to above the ground, m, for which an RPC is fitted."""
    low, high = surface.height_range_m()
    return low - MARGIN_M, high + MARGIN_M


def _difference(rpc: Rpc, ground: tuple[Floats, Floats, Floats], points: Floats) -> RpcError:
    """Distances of the pixels of ground points from image points (N, 2)."""
    distance = np.hypot(*(np.column_stack(rpc.pixels(*ground)) - points).T)
    return RpcError(rms_px=float(np.sqrt(np.mean(distance**2))), largest_px=float(distance.max()))


def rpc_text(rpc: Rpc, error: GroundError) -> str:
    """The RPC as the text that GDAL reads beside an image NAME.tif as NAME_RPC.TXT; its errors on the ground
    are 1 sigma in metres for each horizontal axis, as RPC00B (STDI-0002) defines them.
    """
    names = ("LINE", "SAMP", "LAT", "LONG", "HEIGHT")
    units = ("pixels", "pixels", "degrees", "degrees", "meters")
    rows = [f"ERR_BIAS: {error.bias_m:.4f} meters", f"ERR_RAND: {error.random_m:.4f} meters"]
    for what, values in (("OFF", rpc.offsets), ("SCALE", rpc.scales)):
        rows += [f"{name}_{what}: {value:+.17g} {unit}" for name, value, unit in zip(names, values, units)]
    for name, values in zip(POLYNOMIALS, (rpc.line_num, rpc.line_den, rpc.sample_num, rpc.sample_den)):
        rows += [f"{name}_COEFF_{n}: {value:+.17e}" for n, value in enumerate(values, 1)]
    return "\n".join(rows) + "\n"


def rpc_metadata(rpc: Rpc, error: GroundError) -> dict[str, str]:
    """The RPC by GDAL's names of its metadata domain RPC."""
    rows = dict(line.split(": ", 1) for line in rpc_text(rpc, error).splitlines())
    values = {key: text.split(" ")[0] for key, text in rows.items() if "_COEFF_" not in key}
    for name in POLYNOMIALS:
        values[f"{name}_COEFF"] = " ".join(rows[f"{name}_COEFF_{n}"] for n in range(1, 21))
    return values


def _ground(
    model: Pushbroom, ccd: int, sample: Floats, line: Floats, height_m: Floats
) -> tuple[Floats, Floats]:
    """Latitude and longitude, degrees, of image points (N,) at heights (N,)."""
    p_e = np.full((len(sample), 3), np.nan)
    for height in np.unique(height_m):
        here = height_m == height
        p_e[here] = model.ground_points(ccd, sample[here], line[here], ConstantHeight(float(height)))
    lat, lon, _ = geodetic_from_ecef(p_e)
    if not np.isfinite(p_e).all():
        raise ValueError("the strip's model has no ground for some of its pixels")
    east = (np.degrees(lon - lon[0]) + 180.0) % 360.0 - 180.0  # no step at the date line
    return np.asarray(np.degrees(lat), dtype=float), np.asarray(np.degrees(lon[0]) + east, dtype=float)


def _terms(lat: Floats, lon: Floats, height: Floats) -> Floats:
    """(N, 20) cubic terms in the order of RPC00B: P latitude, L longitude, H height."""
    P, L, H = lat, lon, height
    one = np.ones_like(P)
    first = [one, L, P, H, L * P, L * H, P * H, L**2, P**2, H**2]
    third = [P * L * H, L**3, L * P**2, L * H**2, L**2 * P, P**3, P * H**2, L**2 * H, P**2 * H, H**3]
    return np.stack([*first, *third], axis=1)


def _ratio(terms: Floats, target: Floats, cut: float) -> tuple[Floats, Floats]:
    """Numerator and denominator (20,) each, whose ratio is the target (N,)."""
    A = np.hstack([terms, -target[:, None] * terms[:, 1:]])
    weight = np.ones(len(target))
    solution: Floats = np.zeros(39)
    for _ in range(4):  # each weighted by the denominators of the one before
        solution = np.asarray(
            np.linalg.lstsq(A * weight[:, None], target * weight, rcond=cut)[0], dtype=float
        )
        weight = 1.0 / (terms @ np.concatenate([[1.0], solution[20:]]))
    return np.asarray(solution[:20]), np.concatenate([[1.0], solution[20:]])
