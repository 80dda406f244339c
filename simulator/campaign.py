"""A calibration campaign at the level of vectors: what the cameras would see, with the errors of the
paper's Table 1.

From a plan to `StripSightings` and their truth, or to `VectorSets`; no images. A circular orbit over an Earth
at rest, nadir pointing with waves on all three axes, a line scanner whose rows have their own times.
Strips follow one another; each has an orbit of its own, drawn anew. Frames: i inertial, o orbital (x along
the velocity, z to nadir), c = o but for the waves, s by the installation matrix. SI units, radians.

A strip of the sky scans it at a constant rate about an axis of the remote-sensing camera, so that stars move
along the columns as the ground does; a rate of the other sign scans backwards. No position of the satellite,
no refraction, no map has a part in it. Scans lie before t = 0, where a campaign of the ground begins.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from boresight.geometry import sightings
from boresight.geometry.attitude import ConstantRate
from boresight.geometry.constants import ARCSEC, GM_EARTH, WGS84
from boresight.geometry.gyro import GyroNoise
from boresight.geometry.line_camera import LineSensor
from boresight.records.record import array, record, scalar

__all__ = [
    "CameraPair",
    "DistortionCurve",
    "DrawnStripMotion",
    "LinePair",
    "StripPlan",
    "StripTruth",
    "Waves",
    "draw_frames",
    "draw_sky_strips",
    "draw_strips",
    "draw_targets",
    "installation_by_tilt",
    "noisy",
    "noisy_frames",
    "strip_every_s",
    "unit",
]

Array = NDArray[np.float64]

# Takes vectors from the orbit's axes at its ascending node (x to the satellite, y along the flight, z along
# the orbit's angular momentum) to the orbital frame o (x along the flight, y against the momentum, z to
# nadir).
_R_AT_NODE = Rotation.from_matrix([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])


PAUSE_S = 60.0  # between the exposures of one strip and those of the next (set by hand)


def installation_by_tilt(from_zenith_rad: float, about_boresight_rad: float = 0.0) -> Rotation:
    """`R_cs` of a star camera that looks `from_zenith_rad` off the zenith in the Y-Z plane of c (Z to
    nadir).
    """
    return Rotation.from_rotvec([np.pi - from_zenith_rad, 0.0, 0.0]) * Rotation.from_rotvec(
        [0.0, 0.0, about_boresight_rad]
    )


@record
class LinePair:
    """The remote-sensing camera as it is and as it is assumed, CCD by CCD."""

    true: LineSensor = scalar("that makes the images")
    assumed: LineSensor = scalar("gives the measured samples their look directions")


@record
class CameraPair:
    """Both cameras as far as vectors need them. Defaults are the paper's Tables 2 and 3."""

    R_cs: Rotation  # the true installation matrix
    star_pixel_rad: float = 6.4e-5  # 6.4 µm behind 100 mm
    star_half_width_px: float = 2560.0
    star_half_height_px: float = 1920.0
    pixel_rad: float = 1e-6  # 10 µm behind 10 m
    ccd_px: int = 6144
    n_ccds: int = 4
    line: LinePair | None = None  # None: one straight line of pixels without any error of its own

    @property
    def half_field_rad(self) -> float:
        """Half of the field of view across the track, rad."""
        return 0.5 * self.n_ccds * self.ccd_px * self.pixel_rad


@record(by_value=True)
class StripPlan:
    """What a campaign does and what goes wrong in it. Every sigma may be zero."""

    strips: int = 8
    duration_s: float = 1.8  # of a strip: 26 000 rows of 0.07 ms
    exposures: int = 10  # a strip, evenly over its duration
    stars: int = 40  # an exposure
    exposure_margin_s: float = 0.0  # exposures start before, and end after, the strip by this much
    targets: int = 12  # a strip
    across: tuple[float, float] = (-1.0, 1.0)  # where targets lie across the field, its half width being 1
    along: tuple[float, float] = (0.0, 1.0)  # and along the strip, its length being 1
    sigma_s_px: float = 0.06
    sigma_c_px: float = 0.3
    height_m: float = 530e3
    wave_rad: tuple[float, float] = (3 * ARCSEC, 12 * ARCSEC)  # amplitudes, drawn per strip and axis
    wave_s: tuple[float, float] = (3.0, 7.0)  # periods
    sigma_position_m: float = 0.0  # per axis, constant over a strip (Table 1: 2 m)
    orbit_bias_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # stated less true: along, to the right, up
    clock_bias_s: float = 0.0  # stated less true instant of the rows, common to all strips
    sigma_clock_s: float = 0.0  # of the rows, constant over a strip (Table 1: 0.1 ms)
    sigma_vibration_rad: float = 0.0  # per axis, white from target to target (Table 1: 0.1 arcsec)
    sigma_distortion_rad: float = 0.0  # per axis (Table 1: 0.3 px)
    distortion_length_px: float = 2000.0
    distortion_pixel_rad: float = 0.0  # angle of a pixel: one curve over the field; 0: one for each CCD
    sigma_ccd_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)  # per axis, rms of each CCD's own shift,
    # slope (rotation along x, scale along y) and bend (quadratic)
    distortion_scope: str = "camera"  # one curve for all strips, or "strip"
    sigma_motion_rad: float = 0.0  # motion between the exposures that is stated, per axis, rms
    motion_time_s: float = 0.8  # over which it is smooth
    gyro: GyroNoise | None = None  # of a gyro between the exposures; None: there is none
    gyro_step_s: float = 0.1  # from row to row of it
    sigma_target_m: float = 0.0  # per axis, of the targets' own coordinates
    same_targets: bool = False  # all strips see the same ones on one and the same track: one error each
    gross_stars: float = 0.0  # share of stars with a wrong identity: anywhere in the field
    gross_targets: float = 0.0  # share of targets matched at a wrong place: anywhere within gross_reach_px
    gross_reach_px: float = 500.0


@record
class StripTruth:
    """True values of a drawn campaign of S strips, to test estimates."""

    R_cs: Rotation = scalar("true installation matrix")
    wrong_stars: frozenset[tuple[str, str, int]] = scalar("gross errors: strip, exposure, row")
    wrong_targets: frozenset[tuple[str, int]] = scalar("gross errors: strip, row")
    R_ci: tuple[Rotation, ...] = array("S", "(J,) at the rows' recorded times, without vibration")
    look_c: tuple[Array, ...] = array("S", "(J, 3) true look vectors, with distortion, without noise")
    motion: tuple[DrawnStripMotion, ...] = array("S", "orbit and attitude of each strip against time")
    position_m: tuple[Array, ...] = array(
        "S", "(3,) true less recorded position, frame i, constant over a strip"
    )


def draw_strips(
    plan: StripPlan, cameras: CameraPair, rng: np.random.Generator, *, curve: DistortionCurve | None = None
) -> tuple[list[sightings.StripSightings], StripTruth]:
    """Strips of one campaign with noise drawn from `rng`, and with the camera's distortion `curve`; None:
    drawn too.
    """
    curve = curve or DistortionCurve.draw(plan, cameras, rng)
    survey_i = rng.normal(0.0, plan.sigma_target_m, (plan.targets, 3)) if plan.same_targets else None
    drawn = []
    for n in range(plan.strips):
        if plan.distortion_scope == "strip":
            curve = DistortionCurve.draw(plan, cameras, rng)
        begin_s = n * strip_every_s(plan)
        drawn.append(_draw_strip((f"strip{n:04d}", begin_s), plan, cameras, curve, survey_i, rng))
    return [strip for strip, _ in drawn], StripTruth(
        cameras.R_cs,
        frozenset().union(*(truth.wrong_stars for _, truth in drawn)),
        frozenset().union(*(truth.wrong_targets for _, truth in drawn)),
        tuple(R_ci for _, truth in drawn for R_ci in truth.R_ci),
        tuple(look_c for _, truth in drawn for look_c in truth.look_c),
        tuple(motion for _, truth in drawn for motion in truth.motion),
        tuple(error_m for _, truth in drawn for error_m in truth.position_m),
    )


def strip_every_s(plan: StripPlan) -> float:
    """Time from the beginning of one strip of a campaign to that of the next."""
    return plan.duration_s + 2.0 * plan.exposure_margin_s + PAUSE_S


def draw_frames(
    n_frames: int,
    stars: int | list[Array],
    targets: int,
    sigma_s_px: float,
    sigma_c_px: float,
    cameras: CameraPair,
    rng: np.random.Generator,
    *,
    noise: bool = True,
) -> sightings.VectorSets:
    """The paper's frames: one attitude each, stars and targets over the whole fields, white noise (or none
    yet).

    `stars` is their number a frame, drawn over the field, or one (n, 3) array of true directions u_s a frame.
    """
    if isinstance(stars, int):
        star_start: NDArray[np.int64] = np.arange(n_frames + 1) * stars
        u_s = _star_field(n_frames * stars, cameras, rng)
    else:
        star_start = np.concatenate([[0], np.cumsum([len(field) for field in stars])])
        u_s = np.concatenate(stars)
    target_start = np.arange(n_frames + 1) * targets
    half = cameras.half_field_rad
    w_c = unit(
        np.column_stack([*rng.uniform(-half, half, (2, n_frames * targets)), np.ones(n_frames * targets)])
    )
    R_ic = Rotation.random(n_frames, rng=rng)
    v_stars = R_ic[np.repeat(np.arange(n_frames), np.diff(star_start))].apply(cameras.R_cs.apply(u_s))
    v_targets = R_ic[np.repeat(np.arange(n_frames), targets)].apply(w_c)
    sigma_s, sigma_c = sigma_s_px * cameras.star_pixel_rad, sigma_c_px * cameras.pixel_rad
    exact = sightings.VectorSets(
        star_start=star_start.astype(np.int64),
        u_s=u_s,
        v_stars=v_stars,
        sigma_s=np.full(len(u_s), sigma_s),
        target_start=target_start.astype(np.int64),
        w_c=w_c,
        v_targets=v_targets,
        sigma_c=np.full(len(w_c), sigma_c),
    )
    return noisy_frames(exact, rng) if noise else exact


def noisy_frames(frames: sightings.VectorSets, rng: np.random.Generator) -> sightings.VectorSets:
    """Frames with new noise, of their own sigmas, on both cameras' vectors."""
    return replace(
        frames,
        u_s=noisy(frames.u_s, frames.sigma_s[:, None], rng),
        w_c=noisy(frames.w_c, frames.sigma_c[:, None], rng),
    )


@record
class Waves:
    """Oscillation of the attitude: a sine about each axis of c."""

    amplitude: Array  # (3,) rad
    omega: Array  # (3,) rad/s
    phase: Array  # (3,) rad

    @classmethod
    def draw(cls, plan: StripPlan, rng: np.random.Generator) -> Waves:
        """Waves drawn at random."""
        amplitude, omega = rng.uniform(*plan.wave_rad, 3), 2 * np.pi / rng.uniform(*plan.wave_s, 3)
        return cls(amplitude, omega, rng.uniform(0, 2 * np.pi, 3))

    def at(self, t_s: Array) -> Array:
        """Rotation vectors (N, 3), rad, at instants (N,)."""
        return np.asarray(self.amplitude * np.sin(self.omega * t_s[:, None] + self.phase))


@record
class DrawnStripMotion:
    """Circular orbit and waves of one strip."""

    begin_s: float  # of the strip: zero of the angles
    radius_m: float
    rate: float  # rad/s
    R_ie: Rotation  # orbit's axes (x to the node, z along the orbit's normal) to i
    waves: Waves

    @classmethod
    def draw(cls, plan: StripPlan, begin_s: float, rng: np.random.Generator) -> DrawnStripMotion:
        """A motion of one strip drawn at random."""
        radius = WGS84.semi_major_m + plan.height_m
        R_ie = Rotation.identity() if plan.same_targets else Rotation.random(rng=rng)
        return cls(begin_s, radius, float(np.sqrt(GM_EARTH / radius**3)), R_ie, Waves.draw(plan, rng))

    def position_i(self, t: Array) -> Array:
        """Positions (N, 3) of the satellite, frame i, m, at instants (N,), s."""
        angle = self.rate * (t - self.begin_s)
        return self.R_ie.apply(self.radius_m * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle]))

    def velocity_i(self, t: Array) -> Array:
        """Velocities (N, 3), frame i, m/s."""
        angle = self.rate * (t - self.begin_s)
        speed = self.radius_m * self.rate
        return self.R_ie.apply(speed * np.column_stack([-np.sin(angle), np.cos(angle), 0 * angle]))

    def R_oi(self, t: Array) -> Rotation:
        """Rotations (N,) from frame i to the orbital frame."""
        from_node = Rotation.from_rotvec(np.outer(-self.rate * (t - self.begin_s), [0.0, 0.0, 1.0]))
        return _R_AT_NODE * from_node * self.R_ie.inv()

    def R_co(self, t: Array) -> Rotation:
        """Rotations (N,) from the orbital frame to the remote-sensing camera, without vibration."""
        return Rotation.from_rotvec(self.waves.at(t - self.begin_s))

    def R_ci(self, t: Array) -> Rotation:
        """Rotations (N,) from frame i to the remote-sensing camera, without vibration."""
        return self.R_co(t) * self.R_oi(t)


@record
class DistortionCurve:
    """A smooth random residual of the distortion along the detector, by Fourier waves of its own
    correlation: one curve over the field, or one for each CCD; and shift, slope and bend of each CCD.
    """

    wave: Array  # (2, curves, M) 1/px
    phase: Array  # (2, curves, M)
    sigma_rad: float
    ccd_px: int  # length of a CCD
    modes_rad: Array  # (2, CCDs, 3)

    @classmethod
    def draw(cls, plan: StripPlan, cameras: CameraPair, rng: np.random.Generator) -> DistortionCurve:
        """The curve of the field, or those of the CCDs, and what is each CCD's own, drawn at random."""
        # Matérn 3/2, (1 + a d) exp(-a d), has the spectral density of Student's t with 3 degrees of freedom
        # times a / sqrt(3), and with the area of exp(-d² / (2 length²)) a = 4 / (sqrt(2 pi) length).
        shape = (2, 1 if plan.distortion_pixel_rad else cameras.n_ccds, 200)
        wave = 4.0 / np.sqrt(6.0 * np.pi) * rng.standard_t(3, shape) / plan.distortion_length_px
        phase = rng.uniform(0, 2 * np.pi, shape)
        modes: Array = np.zeros((2, cameras.n_ccds, 3))
        if any(plan.sigma_ccd_rad):
            modes = rng.standard_normal(modes.shape) * plan.sigma_ccd_rad
        return cls(wave, phase, plan.sigma_distortion_rad, cameras.ccd_px, modes)

    def at(self, ccd: NDArray[np.int64], sample: Array) -> Array:
        """(J, 2) rad along x and y of c."""
        t = 2.0 * sample / self.ccd_px - 1.0
        legendre = np.column_stack([np.ones_like(t), t, 1.5 * t * t - 0.5]) * np.sqrt([1.0, 3.0, 5.0])
        own = (self.modes_rad[:, ccd] * legendre).sum(axis=2).T
        if self.wave.shape[1] == 1:  # over the field, where the CCDs lie side by side
            ccd, sample = np.zeros_like(ccd), ccd * self.ccd_px + sample
        waves = np.cos(self.wave[:, ccd] * sample[:, None] + self.phase[:, ccd])
        return np.asarray(own + self.sigma_rad * np.sqrt(2.0 / waves.shape[2]) * waves.sum(axis=2).T)


def _draw_strip(
    begins: tuple[str, float],
    plan: StripPlan,
    cameras: CameraPair,
    curve: DistortionCurve,
    survey_i: Array | None,
    rng: np.random.Generator,
) -> tuple[sightings.StripSightings, StripTruth]:
    (name, begin_s), margin = begins, plan.exposure_margin_s
    motion = DrawnStripMotion.draw(plan, begin_s, rng)
    since: Array = np.linspace(-margin, plan.duration_s + margin, plan.exposures, dtype=np.float64)
    t_stars = begin_s + since
    R_oi_stars = motion.R_oi(t_stars)
    R_ci_stars = motion.R_co(t_stars) * R_oi_stars
    exposures, wrong_stars = draw_exposures(name, t_stars, plan, cameras, R_ci_stars, rng)
    t = begin_s + plan.duration_s * np.sort(rng.uniform(*plan.along, plan.targets))
    R_oi = motion.R_oi(t)
    rows = t, R_oi, motion.R_co(t) * R_oi
    shared = curve, survey_i
    ground, wrong_rows, look_c, error_m = draw_targets(name, rows, plan, cameras, motion, shared, rng)
    strip = sightings.StripSightings(
        strip_id=name, exposures=exposures, ground=ground, R_oi_exposures=R_oi_stars, R_oi_targets=R_oi
    )
    wrong_targets = frozenset((name, row) for row in wrong_rows)
    return strip, StripTruth(
        cameras.R_cs, frozenset(wrong_stars), wrong_targets, (rows[2],), (look_c,), (motion,), (error_m,)
    )


def draw_exposures(
    name: str, t: Array, plan: StripPlan, cameras: CameraPair, R_ci: Rotation, rng: np.random.Generator
) -> tuple[tuple[sightings.StarSightings, ...], set[tuple[str, str, int]]]:
    """Exposures at instants (K,) of attitudes (K,), and the gross errors: strip, exposure, row."""
    K, n = len(t), plan.stars
    R_is = (R_ci.inv() * cameras.R_cs).as_matrix()
    sigma = plan.sigma_s_px * cameras.star_pixel_rad
    truth = _star_field(K * n, cameras, rng).reshape(K, n, 3)
    wrong = rng.random((K, n)) < plan.gross_stars
    named = np.where(wrong[:, :, None], _star_field(K * n, cameras, rng).reshape(K, n, 3), truth)
    u_i = named @ np.swapaxes(R_is, 1, 2)
    u_s = noisy(truth, sigma, rng)
    xy_px = -u_s[..., :2] / u_s[..., 2:] / cameras.star_pixel_rad
    covariance = sightings.isotropic_covariance(u_s.reshape(-1, 3), sigma).reshape(K, n, 3, 3)
    hip = np.arange(1, n + 1, dtype=np.int64)
    ids = [f"{name}/{k:03d}" for k in range(K)]
    exposures = tuple(
        sightings.StarSightings(
            exposure_id=ids[k],
            t_s=float(t[k]),
            hip=hip,
            xy_px=xy_px[k],
            u_s=u_s[k],
            u_i=u_i[k],
            cov_s=covariance[k],
        )
        for k in range(K)
    )
    return exposures, {(name, ids[k], row) for k, row in np.argwhere(wrong).tolist()}


def draw_targets(
    name: str,
    rows: tuple[Array, Rotation, Rotation],
    plan: StripPlan,
    cameras: CameraPair,
    motion: DrawnStripMotion,
    shared: tuple[DistortionCurve, Array | None],
    rng: np.random.Generator,
    error_m: Array | None = None,
) -> tuple[sightings.GroundSightings, list[int], Array, Array]:
    """Targets at rows of recorded times (J,), of which R_oi and R_ci are known; the error of the position is
    drawn unless it is given.
    """
    t, R_oi, R_ci = rows
    J, px = len(t), cameras.pixel_rad
    curve, survey_i = shared
    ccd, sample, u_c, assumed_c = looks_across(rng.uniform(*plan.across, J), cameras)
    t_true = t + rng.normal(0.0, plan.sigma_clock_s) - plan.clock_bias_s
    R_ci_true = R_ci if np.array_equal(t_true, t) else motion.R_ci(t_true)
    vibration = rng.normal(0.0, plan.sigma_vibration_rad, (J, 3))  # that the exposures do not follow
    R_ic = (Rotation.from_rotvec(vibration) * R_ci_true).inv()
    truth_i = motion.position_i(t_true)
    ground_i = truth_i + plan.height_m / u_c[:, 2:] * R_ic.apply(u_c)
    error_m = rng.normal(0.0, plan.sigma_position_m, 3) if error_m is None else error_m
    recorded_i = motion.position_i(t) - error_m
    bias_o = np.array(plan.orbit_bias_m) * [1.0, 1.0, -1.0]
    recorded_i = recorded_i + R_oi.inv().apply(np.tile(bias_o, (J, 1)))
    own_i = rng.normal(0.0, plan.sigma_target_m, (J, 3)) if survey_i is None else survey_i
    known_i = ground_i + own_i
    range_m = np.linalg.norm(known_i - recorded_i, axis=1)
    seen = assumed_c + np.pad(curve.at(ccd, sample), ((0, 0), (0, 1)))
    wrong = np.flatnonzero(rng.random(J) < plan.gross_targets)
    seen[wrong, :2] += px * rng.uniform(-plan.gross_reach_px, plan.gross_reach_px, (len(wrong), 2))
    prefix = name if survey_i is None else "site"
    sigma = plan.sigma_c_px * px
    look_c = unit(seen)
    measured = noisy(look_c, sigma, rng)
    ground = sightings.GroundSightings(
        target_id=np.array([f"{prefix}/{j:03d}" for j in range(J)], dtype=str),
        ccd=ccd,
        xy_px=np.column_stack([sample, t - motion.begin_s]),
        t_s=t,
        u_c=measured,
        u_i=(known_i - recorded_i) / range_m[:, None],
        cov_c=sightings.isotropic_covariance(measured, sigma),
        range_m=range_m,
        v_rel_i=motion.velocity_i(t),
        cov_target_i=np.tile(plan.sigma_target_m**2 * np.eye(3), (J, 1, 1)),
        earth_i=np.zeros((J, 3, 3)),
        light_i=np.zeros((J, 3, 4)),
    )
    return ground, wrong.tolist(), look_c, error_m


def looks_across(place: Array, cameras: CameraPair) -> tuple[NDArray[np.int64], Array, Array, Array]:
    """CCD (J,), sample (J,), true and assumed look vectors (J, 3), frame c, of places (J,) across the field,
    its half width being 1.
    """
    half = cameras.half_field_rad
    y = half * place
    pixel = np.clip((y + half) / cameras.pixel_rad, 0.0, cameras.n_ccds * cameras.ccd_px * (1.0 - 1e-12))
    ccd = np.floor(pixel / cameras.ccd_px).astype(np.int64)
    sample = pixel - ccd * cameras.ccd_px
    flat = unit(np.column_stack([0 * y, y, np.ones(len(y))]))
    if cameras.line is None:
        return ccd, sample, flat, flat
    looks = np.zeros((2, len(ccd), 3))
    for n, camera in enumerate((cameras.line.true, cameras.line.assumed)):
        for c in np.unique(ccd).tolist():
            looks[n, ccd == c] = camera.directions_from_pixels(c, sample[ccd == c])
    return ccd, sample, looks[0], looks[1]


def _star_field(n: int, cameras: CameraPair, rng: np.random.Generator) -> Array:
    xy = rng.uniform(-1.0, 1.0, (n, 2)) * [cameras.star_half_width_px, cameras.star_half_height_px]
    return unit(np.column_stack([-cameras.star_pixel_rad * xy, np.ones(n)]))


def noisy(u: Array, sigma: float | Array, rng: np.random.Generator) -> Array:
    """Unit vectors (..., 3) with noise of 1-sigma `sigma`, rad, on each axis."""
    return unit(u + sigma * rng.standard_normal(u.shape))


def unit(v: Array) -> Array:
    """Vectors (..., 3) scaled to length one."""
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True))


def draw_sky_strips(
    plan: StripPlan,
    cameras: CameraPair,
    rng: np.random.Generator,
    *,
    rates_rad_s: tuple[float, ...] = (-0.0145, 0.0145),
    sigma_star_rad: float = 0.0,
    curve: DistortionCurve | None = None,
) -> list[sightings.StripSightings]:
    """Strips of one campaign of `plan.strips` scans, at the rates in turn (10 m camera: a row of 1 µrad in
    0.07 ms). `plan.targets` is the number of stars a strip, `sigma_star_rad` the error of their catalogue,
    `curve` the camera's distortion; None: drawn here.
    """
    curve = curve or DistortionCurve.draw(plan, cameras, rng)
    strips = []
    for n in range(plan.strips):
        begin_s, rate = -(n + 1) * strip_every_s(plan), rates_rad_s[n % len(rates_rad_s)]
        scan = ConstantRate(begin_s, Rotation.random(rng=rng), np.array([0.0, rate, 0.0]))  # about y of c
        strips.append(_draw_sky_strip(f"sky{n:04d}", plan, scan, cameras, curve, sigma_star_rad, rng))
    return strips


def _draw_sky_strip(
    name: str,
    plan: StripPlan,
    scan: ConstantRate,
    cameras: CameraPair,
    curve: DistortionCurve,
    sigma_star_rad: float,
    rng: np.random.Generator,
) -> sightings.StripSightings:
    margin, J, waves = plan.exposure_margin_s, plan.targets, Waves.draw(plan, rng)

    def R_ci(t_s: Array) -> Rotation:
        """Attitudes of the camera, without vibration."""
        return Rotation.from_rotvec(waves.at(t_s - scan.t_s)) * scan.R_oi(t_s)

    since: Array = np.linspace(-margin, plan.duration_s + margin, plan.exposures, dtype=np.float64)
    t_stars = scan.t_s + since
    exposures, _ = draw_exposures(name, t_stars, plan, cameras, R_ci(t_stars), rng)
    t = scan.t_s + plan.duration_s * np.sort(rng.uniform(*plan.along, J))
    ccd, sample, true_c, assumed_c = looks_across(rng.uniform(*plan.across, J), cameras)
    t_true = t + rng.normal(0.0, plan.sigma_clock_s) - plan.clock_bias_s
    vibration = rng.normal(0.0, plan.sigma_vibration_rad, (J, 3))  # that the exposures do not follow
    R_ic = (Rotation.from_rotvec(vibration) * R_ci(t_true)).inv()
    catalogue_i = noisy(R_ic.apply(true_c), sigma_star_rad, rng)
    seen = unit(assumed_c + np.pad(curve.at(ccd, sample), ((0, 0), (0, 1))))
    sigma = plan.sigma_c_px * cameras.pixel_rad
    measured = noisy(seen, sigma, rng)
    stars = sightings.GroundSightings.of_stars(
        target_id=np.array([f"HIP {1000 * int(name[3:]) + j}" for j in range(J)], dtype=str),
        ccd=ccd,
        xy_px=np.column_stack([sample, t - scan.t_s]),
        t_s=t,
        u_c=measured,
        u_i=catalogue_i,
        cov_c=sightings.isotropic_covariance(measured, sigma),
        cov_target_i=sightings.isotropic_covariance(catalogue_i, sigma_star_rad),
    )
    return sightings.StripSightings(
        strip_id=name,
        exposures=exposures,
        ground=stars,
        R_oi_exposures=scan.R_oi(t_stars),
        R_oi_targets=scan.R_oi(t),
    )
