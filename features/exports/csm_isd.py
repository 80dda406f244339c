"""USGS CSM line-scanner image support data (ISD, JSON) of one CCD of a strip, for ISIS, ASP and other users
of `usgscsm`.

Written for `USGS_ASTRO_LINE_SCANNER_SENSOR_MODEL` and the reader of the Abstraction Layer for Ephemerides
(ALE). That model knows straight rays from a moving camera in the Earth-fixed frame, an affine detector, and a
cubic distortion. So

* its camera frame is frame c rotated by 180 degrees about x (its z axis points away from the ground);
* aberration, light time and refraction are included in position and attitude at a stated height: at each node
  the rotation is the one that best takes the camera's look directions to the true lines of sight;
* positions and attitudes are in ITRS, and the body's rotation is the identity;
* where a cubic does not fit the distortion table, the detector is cut into pieces, each an image of its own.

The approximation error is written into each file as `boresight.model_error_px`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import erfa
import numpy as np
from scipy.spatial.transform import Rotation

from boresight.features.exports.quaternions import continuous_quaternions
from boresight.geometry.constants import WGS84
from boresight.geometry.epoch import TT_MINUS_TAI_S, Epoch
from boresight.geometry.geodesy import ray_ellipsoid_intersection
from boresight.geometry.groundlight import lines_of_sight_e
from boresight.geometry.line_camera import Ccd, LineCamera, LookAngleCamera
from boresight.geometry.pushbroom import Pushbroom
from boresight.records.record import Floats, array, record, scalar

__all__ = ["IsdNames", "IsdPiece", "line_scanner_isds", "parameter_covariance"]

NODE_STEP_S = 2.0**-7  # node times are then exact in ephemeris seconds, which resolve only 1e-7 s
MARGIN_NODES = 8  # on either side: the model interpolates with eight points
FIT_SAMPLES = 9  # look directions per node, to which the rotation is fitted
DISTORTION_PX = 3e-3  # largest misfit of the cubic
# Fewest samples of a piece of a CCD that gets an ISD of its own.
SMALLEST_PIECE_PX = 32
_HALF_TURN = Rotation.from_quat([1.0, 0.0, 0.0, 0.0])  # c to the sensor's axes of an ISD: 180 degrees about x


@record
class IsdNames:
    """Names in an ISD."""

    image: str = scalar("file name of the raw image")
    platform: str = scalar("satellite or mission")
    sensor: str = scalar("camera and CCD")


@record
class IsdPiece:
    """One ISD, valid for first_sample <= sample < stop_sample of the raw image."""

    ccd: int = scalar("index of the CCD")
    first_sample: int = scalar("first sample")
    stop_sample: int = scalar("one after the last sample")
    isd: dict[str, Any] = scalar("content of the JSON file")
    whole_detector: bool = scalar("the ISD covers all samples of the CCD")
    approximate: bool = scalar("one cubic for a CCD that needs several; see model_error_px", default=False)

    @property
    def suffix(self) -> str:
        """Part of the file name: `ccd0`, or `ccd0.samples-00512-01023` for a piece."""
        if self.approximate:
            return f"ccd{self.ccd}.whole"
        if self.whole_detector:
            return f"ccd{self.ccd}"
        return f"ccd{self.ccd}.samples-{self.first_sample:05d}-{self.stop_sample - 1:05d}"

    def text(self, about: Mapping[str, Any] | None = None) -> str:
        """The ISD as JSON text, with `about` in its table `boresight`."""
        content = self.isd | {"boresight": self.isd["boresight"] | dict(about or {})}
        return json.dumps(content, indent=1, allow_nan=False) + "\n"


@record(kw_only=True)
class _Path:
    """Camera centre and attitude at N equally spaced nodes; aberration, light time, refraction included."""

    et_s: Floats = array("N", "ephemeris seconds: TDB since J2000")
    t_s: Floats = array("N", "the same instants, TAI seconds since the epoch")
    p_e: Floats = array("N, 3", "camera centre, m, ITRS")
    v_e: Floats = array("N, 3", "its velocity, m/s, ITRS")
    R_ec: Rotation = array("N", "camera to ITRS")
    misfit_rad: float = scalar("largest angle between the true lines of sight and those of one rotation")


def line_scanner_isds(
    pushbroom: Pushbroom, epoch: Epoch, ccd: int, lines: int, height_m: float, names: IsdNames
) -> list[IsdPiece]:
    """ISDs of the image of one CCD, of `lines` lines, exact for ground at the ellipsoidal height `height_m`.

    Where the CCD is cut into pieces, the last one is of the whole CCD, with the misfit of one cubic in its
    error.

    Raises `ValueError` for a camera that is neither a `LineCamera` nor a `LookAngleCamera`.
    """
    camera = pushbroom.camera
    if isinstance(camera, LookAngleCamera):
        camera = camera.with_focal_plane()
    if not isinstance(camera, LineCamera):
        raise ValueError("only a camera with a focal plane or look tables has an ISD")
    path = _path(pushbroom, epoch, ccd, lines, height_m)
    start_t_s = float(pushbroom.instants_of_lines(ccd, np.array([-0.5]))[0])
    common = _common(path, pushbroom, (lines, start_t_s), height_m, names, camera.focal_m)
    detector = camera.ccds[ccd]
    pieces = _pieces(detector)
    whole = [(0, detector.n_px, *_cubic(detector, 0, detector.n_px))] if len(pieces) > 1 else []
    made = []
    for first, stop, coefficients, residual_px in [*pieces, *whole]:
        error_px = residual_px + path.misfit_rad * camera.focal_m / detector.pixel_m
        content = common | _detector(detector, first, stop, coefficients)
        content["boresight"] = common["boresight"] | {
            "ccd": ccd,
            "first_sample": first,
            "stop_sample": stop,
            "model_error_px": error_px,
        }
        covers_all = stop - first == detector.n_px
        made.append(IsdPiece(ccd, first, stop, content, covers_all, covers_all and len(pieces) > 1))
    return made


def parameter_covariance(cov_theta: Floats) -> dict[str, Any]:
    """Covariance of the model's parameters omega, phi and kappa bias by that of theta (3, 3), frame c, rad².

    `usgscsm` counts these in metres: `m_covariance` has them in rows 6 to 8, omega and phi multiplied by the
    state's `m_flyingHeight`, kappa by its `m_halfSwath`. An ISD has no place for them.
    """
    H = _HALF_TURN.as_matrix()
    return {
        "parameters": ["OMEGA_BIAS", "PHI_BIAS", "KAPPA_BIAS"],
        "unit": "rad2, axes of the sensor",
        "covariance": (H @ cov_theta @ H.T).tolist(),
    }


def _path(pushbroom: Pushbroom, epoch: Epoch, ccd: int, lines: int, height_m: float) -> _Path:
    """Nodes over a strip and as much of its margins as attitude and orbit cover; else `ValueError`."""
    t_first, t_last = pushbroom.instants_of_lines(ccd, np.array([-0.5, lines - 0.5]))
    et_minus_t = _ephemeris_seconds(epoch, 0.5 * (t_first + t_last)) - 0.5 * (t_first + t_last)
    low = np.floor((t_first + et_minus_t) / NODE_STEP_S) - MARGIN_NODES
    high = np.ceil((t_last + et_minus_t) / NODE_STEP_S) + MARGIN_NODES
    et = np.arange(low, high + 1) * NODE_STEP_S
    t = et - et_minus_t
    spans = pushbroom.attitude.span_s, pushbroom.orbit.span_s
    inside = (t >= max(s[0] for s in spans)) & (t <= min(s[1] for s in spans))
    if not (t[inside][0] <= t_first + NODE_STEP_S and t[inside][-1] >= t_last - NODE_STEP_S):
        raise ValueError("orbit or attitude do not cover the strip")
    et, t = et[inside], t[inside]
    p_e, R_ec, misfit = _states(pushbroom, ccd, t, height_m)
    v_e = np.gradient(p_e, NODE_STEP_S, axis=0, edge_order=2)
    return _Path(et_s=et, t_s=t, p_e=p_e, v_e=v_e, R_ec=R_ec, misfit_rad=misfit)


def _states(pushbroom: Pushbroom, ccd: int, t_s: Floats, height_m: float) -> tuple[Floats, Rotation, float]:
    """Origins (N, 3), rotations c -> e whose straight rays meet the ground seen, and the largest misfit."""
    n_px = pushbroom.camera.n_px(ccd)
    samples = np.linspace(0.0, n_px - 1.0, FIT_SAMPLES)
    u_c = pushbroom.camera.directions_from_pixels(ccd, samples)
    R_ic = (pushbroom.R_cs * pushbroom.attitude.R_si(t_s)).inv()
    u_i = np.einsum("nij,kj->nki", R_ic.as_matrix(), u_c).reshape(-1, 3)
    t_each = np.repeat(t_s, FIT_SAMPLES)
    rays = lines_of_sight_e(u_i, t_each, pushbroom.orbit, pushbroom.earth, pushbroom.effects, height_m)
    ground = ray_ellipsoid_intersection(*rays, height_m).reshape(len(t_s), FIT_SAMPLES, 3)
    if not np.isfinite(ground).all():
        raise ValueError(f"a line of sight does not meet the height of {height_m:.0f} m")
    p_e = rays[0].reshape(len(t_s), FIT_SAMPLES, 3)[:, FIT_SAMPLES // 2]
    wanted = ground - p_e[:, None, :]
    wanted /= np.linalg.norm(wanted, axis=2, keepdims=True)
    quaternions, misfit = np.empty((len(t_s), 4)), 0.0
    for n in range(len(t_s)):
        R_ec, _ = Rotation.align_vectors(wanted[n], u_c)
        quaternions[n] = R_ec.as_quat()
        misfit = max(misfit, float(np.linalg.norm(R_ec.apply(u_c) - wanted[n], axis=1).max()))
    return p_e, Rotation.from_quat(quaternions), misfit


def _common(
    path: _Path,
    pushbroom: Pushbroom,
    image: tuple[int, float],
    height_m: float,
    names: IsdNames,
    focal_m: float,
) -> dict[str, Any]:
    """What all pieces of a detector have in common; its image has so many lines, from an instant on."""
    lines, start_t_s = image
    middle, times = len(path.t_s) // 2, path.et_s.tolist()
    start_from_centre_s, centre_et_s = start_t_s - float(path.t_s[middle]), times[middle]
    sensor_from_e = continuous_quaternions(_HALF_TURN * path.R_ec.inv())[:, [3, 0, 1, 2]]  # scalar first
    rate_e = _angular_velocities(path.R_ec)
    sun_km = _sun_e(pushbroom, path) / 1e3
    return {
        "isis_camera_version": 2,
        "name_model": "USGS_ASTRO_LINE_SCANNER_SENSOR_MODEL",
        "image_identifier": names.image,
        "name_platform": names.platform,
        "name_sensor": names.sensor,
        "image_lines": lines,
        "interpolation_method": "lagrange",
        "starting_ephemeris_time": centre_et_s + start_from_centre_s,
        "center_ephemeris_time": centre_et_s,
        "line_scan_rate": [[0.5, start_from_centre_s, pushbroom.rows.row_period_s]],
        "radii": {"semimajor": WGS84.semi_major_m / 1e3, "semiminor": WGS84.semi_minor_m / 1e3, "unit": "km"},
        "reference_height": {"minheight": -1000.0, "maxheight": 9000.0, "unit": "m"},
        "focal_length_model": {"focal_length": focal_m * 1e3},
        "body_rotation": _orientation([times[0], times[-1]], [[1.0, 0.0, 0.0, 0.0]] * 2, [[0.0] * 3] * 2),
        "instrument_pointing": _orientation(times, sensor_from_e.tolist(), rate_e.tolist()),
        "instrument_position": {
            "ephemeris_times": times,
            "positions": (path.p_e / 1e3).tolist(),
            "velocities": (path.v_e / 1e3).tolist(),
            "reference_frame": 1,
        },
        "sun_position": {
            "ephemeris_times": [centre_et_s],
            "positions": [sun_km.tolist()],
            "velocities": [[0.0, 0.0, 0.0]],
            "reference_frame": 1,
        },
        "boresight": {
            "frame": "positions, attitudes and Sun in ITRS; the body rotation is the identity",
            "included": "aberration, light time and refraction, exact at height_m",
            "height_m": height_m,
        },
    }


def _orientation(
    times: list[float], quaternions: list[list[float]], rates: list[list[float]]
) -> dict[str, Any]:
    """Rotations against time in the layout of the ISD, all between frames numbered 1."""
    return {
        "time_dependent_frames": [1],
        "ephemeris_times": times,
        "quaternions": quaternions,
        "angular_velocities": rates,
        "constant_frames": [1],
        "constant_rotation": np.eye(3).ravel().tolist(),
        "reference_frame": 1,
    }


def _detector(detector: Ccd, first: int, stop: int, coefficients: tuple[Floats, Floats]) -> dict[str, Any]:
    """Affine detector in the rotated frame, millimetres: y' = -y. CSM's sample is ours + 0.5."""
    per_mm, mirrored = 1e-3 / detector.pixel_m, np.array([1.0, -1.0])
    centre_mm = mirrored * detector.axis_point * 1e3
    samples, lines = (mirrored * one * per_mm for one in (detector.axis, detector.normal))
    return {
        "image_samples": stop - first,
        "detector_sample_summing": 1,
        "detector_line_summing": 1,
        "starting_detector_sample": first,
        "starting_detector_line": 0,
        "detector_center": {"sample": detector.principal_sample + 0.5, "line": 0.0},
        "focal2pixel_samples": [float(-samples @ centre_mm), *samples.tolist()],
        "focal2pixel_lines": [float(-lines @ centre_mm), *lines.tolist()],
        "optical_distortion": {"transverse": {"x": coefficients[0].tolist(), "y": coefficients[1].tolist()}},
    }


def _pieces(detector: Ccd) -> list[tuple[int, int, tuple[Floats, Floats], float]]:
    """(first, stop, cubic coefficients, misfit in px) of each piece of a detector."""
    pieces: list[tuple[int, int, tuple[Floats, Floats], float]] = []
    first = 0
    while first < detector.n_px:
        stop = _longest(detector, first)
        if detector.n_px - stop < SMALLEST_PIECE_PX:
            stop = detector.n_px
        pieces.append((first, stop, *_cubic(detector, first, stop)))
        first = stop
    return pieces


def _longest(detector: Ccd, first: int) -> int:
    """End of the longest piece from `first` on whose cubic fits, by bisection."""
    good, bad = min(first + SMALLEST_PIECE_PX, detector.n_px), detector.n_px + 1
    while bad - good > 1:
        middle = (good + bad) // 2
        if _cubic(detector, first, middle)[1] <= DISTORTION_PX:
            good = middle
        else:
            bad = middle
    return good


def _cubic(detector: Ccd, first: int, stop: int) -> tuple[tuple[Floats, Floats], float]:
    """Coefficients (mm) of CSM's transverse model, from ideal to real image points, and the largest misfit,
    px.
    """
    sample = np.linspace(first - 0.5, stop - 0.5, max(64, min(stop - first, 1024)))
    ideal = detector.focal_plane(sample) * [1e3, -1e3]
    offset = detector.bare.focal_plane(sample) * [1e3, -1e3] - ideal
    x, y = np.zeros(10), np.zeros(10)
    x[1] = y[2] = 1.0
    misfit = np.empty_like(offset)
    for axis, target in enumerate((x, y)):
        fit = np.polynomial.Polynomial.fit(ideal[:, 1], offset[:, axis], 3)
        misfit[:, axis] = offset[:, axis] - fit(ideal[:, 1])
        terms = np.asarray(fit.convert().coef, dtype=np.float64)
        target[[0, 2, 5, 9][: len(terms)]] += terms
    residual_px = float(np.hypot(*misfit.T).max()) * 1e-3 / detector.pixel_m
    return (x, y), residual_px


def _angular_velocities(R_ec: Rotation) -> Floats:
    """Of the camera in axes e, rad/s, from neighbouring nodes."""
    steps = (R_ec[1:] * R_ec[:-1].inv()).as_rotvec() / NODE_STEP_S
    return np.concatenate([steps[:1], 0.5 * (steps[1:] + steps[:-1]), steps[-1:]])


def _ephemeris_seconds(epoch: Epoch, t_s: float) -> float:
    """TDB seconds since J2000 (geocentric terms; 2 us)."""
    day, since = epoch.tt_jd(t_s)
    tdb_minus_tt = float(erfa.dtdb(float(day), float(since), 0.0, 0.0, 0.0, 0.0))
    return epoch.tai_s + t_s + TT_MINUS_TAI_S + tdb_minus_tt


def _sun_e(pushbroom: Pushbroom, path: _Path) -> Floats:
    """Geocentric Sun at the middle node, m, ITRS."""
    t = path.t_s[len(path.t_s) // 2]
    earth = pushbroom.earth
    day, since = earth.epoch.tt_jd(t)
    heliocentric, _ = erfa.epv00(float(day), float(since))
    sun_i = -np.asarray(heliocentric["p"]) * 149_597_870_700.0
    return np.asarray(earth.matrices_ie(np.array([t]))[0].T @ sun_i)
