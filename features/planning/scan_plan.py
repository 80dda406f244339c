"""Which scans of the sky tell most: candidates in time and pointing, away from Sun, Moon and Earth.

Of each candidate both cameras must be clear of the three. Which stars cross which CCD, and when, follows from
the catalogue and the camera; their information about the installation matrix adds to that of the others, and
the scan is taken next that makes the error of the look directions over the field smallest (greedy). Sun and
Moon are ERFA's (`epv00`, `moon98`), beyond its nodes the orbit is continued under gravity with J2.
"""

from __future__ import annotations

from collections.abc import Callable

import erfa
import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from boresight.calib.calibration import strip_pairs
from boresight.calib.information import InformationPairs, solve_total
from boresight.calib.settings import CalibrationSettings
from boresight.geometry.attitude_noise import NO_NOISE, AttitudeNoise
from boresight.geometry.constants import WGS84
from boresight.geometry.epoch import Epoch
from boresight.geometry.geodesy import unit_vectors
from boresight.geometry.line_camera import LineSensor
from boresight.geometry.orbit import Orbit, OrbitGapError
from boresight.geometry.sightings import (
    GroundSightings,
    StripSightings,
    exposure_without_stars,
    isotropic_covariance,
    solved_attitudes,
)
from boresight.geometry.star_camera import StarCamera
from boresight.geometry.starlight import SurveyedStars, apparent_star_directions
from boresight.pipeline.console.arguments import option
from boresight.records.record import Floats, Ints, array, check_numbers, record, scalar
from boresight.simulator.motion import acceleration

__all__ = ["PlannedScan", "ScanCameras", "ScanChoice", "ScanSettings", "angles_to_bodies", "choose_scans"]

TRIES = 200  # pointings drawn for one candidate
APART_S = 1e4  # between candidates where they are compared: longer than any scan
COMPARED = 5  # pointings clear of the bodies whose stars are counted: that with most is the candidate
FIELD_RAD = 0.012  # half-angle of the cone in which they are counted
Z = np.array([0.0, 0.0, 1.0])  # line of sight, in frames s and c


@record(by_value=True)
class ScanSettings:
    """How scans are made and what they must keep away from."""

    hours: float = option("Length of the time to choose from.", 24.0, min=0.1)
    count: int = option("Number of scans wanted.", 2, "--scans", min=1)
    candidates: int = option("Scans to choose from.", 200, min=2, max=5000)
    duration_s: float = option("Length of a scan.", 7.2, min=0.1)
    rate_mrad_s: float = option("Rate, forward and backward in turn.", 3.6, min=0.01)
    exposures_hz: float = 5.0
    v_mag: float = option("Faintest star that is measured in a strip.", 9.0)
    star_sigma_px: float = 0.1  # in a strip, each axis
    head_v_mag: float = 6.0  # faintest star of the star camera
    head_sigma_px: float = 0.06
    sun_deg: float = option("Least angle of both cameras to the Sun.", 60.0, min=0.0)
    moon_deg: float = option("... to the Moon.", 20.0, min=0.0)
    earth_deg: float = option("... above the Earth's limb.", 15.0, min=0.0)
    seed: int = option("Seed of the candidates.", 1, min=0)

    def __post_init__(self) -> None:
        check_numbers(self, zero=("sun_deg", "moon_deg", "earth_deg", "seed"))
        object.__setattr__(self, "candidates", max(self.candidates, self.count))


# Gravity with J2 alone: what it leaves out of a low orbit, drag above all, is some 10 km after a day and 100
# after three: 1 deg from the Earth's centre, far less than the angles kept to the Earth's limb.
MOST_CONTINUED_S = 3.0 * 86400.0


@record(kw_only=True)
class ScanCameras:
    """Both cameras, the matrix between them, and the satellite's orbit."""

    line: LineSensor = scalar("remote-sensing camera")
    star: StarCamera | Floats = scalar(
        "star camera, or, where it delivers attitudes, their covariance (3, 3), rad², axes of s"
    )
    R_cs: Rotation = scalar("installation matrix, star camera to remote-sensing camera")
    orbit: Orbit = scalar("of the satellite")
    noise: AttitudeNoise = scalar("errors of the attitudes beside that covariance", default=NO_NOISE)


@record(kw_only=True)
class PlannedScan:
    """One scan of the sky."""

    t_s: float = scalar("beginning, TAI seconds since the orbit's epoch")
    R_ci: Rotation = scalar("attitude of the remote-sensing camera then, GCRS to frame c")
    rate_rad_s: float = scalar(
        "rotation of the camera about its y axis; positive: stars pass as the ground does"
    )
    stars: int = scalar("stars in the strip")
    head_stars: int = scalar("stars of the star camera; 0 where it delivers attitudes")
    away_deg: Floats = array("3", "least angle of both axes to the Sun, the Moon and the Earth's limb")


@record
class ScanChoice:
    """Scans in the order in which they were taken, and what they forecast."""

    scans: tuple[PlannedScan, ...] = array("N", "in order")
    sigma_rad: Floats = array("N, 3", "1-sigma about the axes of c with the scans so far")
    random_sigma_rad: Floats = array("3", "the same of as many candidates at random, medians")
    candidates: int = scalar("scans with stars, clear of Sun, Moon and Earth")


def choose_scans(
    cameras: ScanCameras,
    stars: SurveyedStars,
    start_s: float,
    errors: CalibrationSettings,
    settings: ScanSettings,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> ScanChoice:
    """The best scans from `start_s` on, TAI seconds since the orbit's epoch.

    Of the catalogue `stars` only those are used that it describes well as single; `errors` has the priors of
    clock, vibration and distortion; `progress` gets the candidates that were looked at, and all.

    Raises `ValueError` if fewer candidates than `settings.count` are clear of Sun, Moon and Earth and hold
    stars, or the time lies further from the orbit's than `MOST_CONTINUED_S`.
    """
    _check_reach(cameras.orbit, start_s, start_s + 3600.0 * settings.hours)
    rng = np.random.default_rng(settings.seed)
    instants = start_s + 3600.0 * settings.hours * np.arange(settings.candidates) / settings.candidates
    p_i, v_i = _states(cameras.orbit, instants)
    sky = _Sky.of(stars, cameras.orbit.epoch.julian_year(np.array([start_s]))[0])
    found = []
    for n, t in enumerate(instants.tolist()):
        rate = 1e-3 * settings.rate_mrad_s * (-1.0) ** n
        one = _candidate(f"scan{n:05d}", cameras, sky, (t, p_i[n], v_i[n]), rate, settings, rng)
        if one is not None:
            found.append(one)
        progress(n + 1, settings.candidates)
    if len(found) < settings.count:
        raise ValueError(
            f"{len(found)} of {settings.candidates} candidates hold stars, clear of Sun, Moon and Earth; "
            f"{settings.count} are needed; more candidates or hours, fainter stars or smaller angles help"
        )
    apart = [strip.later(n * APART_S) for n, (_, strip) in enumerate(found)]  # candidates share no error
    pairs, prior = strip_pairs(apart, cameras.R_cs, errors)
    half = 0.5 * sum(cameras.line.n_px(c) for c in range(cameras.line.n_ccds)) * cameras.line.pixel_rad
    weight = np.array([1.0, 1.0, half**2 / 3.0])  # variance of looks, mean over the field
    place = {name: k for k, name in enumerate(pairs.names.tolist())}
    order = [place[strip.strip_id] for _, strip in found]
    chosen, sigmas = _greedy(pairs.F[order], prior, weight, settings.count, errors)
    at_random = _at_random(pairs, prior, settings.count, errors, rng)
    return ScanChoice(tuple(found[k][0] for k in chosen), sigmas, at_random, len(found))


@record
class _Sky:
    """A catalogue with directions for coarse selection."""

    stars: SurveyedStars = scalar("single stars of a catalogue")
    u_i: Floats = array("N, 3", "directions with proper motion, GCRS")

    @classmethod
    def of(cls, stars: SurveyedStars, year: float) -> _Sky:
        stars = stars.take(stars.single)
        p = stars.places
        dt = year - p.epoch_jyear
        ra, dec = p.ra_rad + dt * p.pm_ra_rad_yr, p.dec_rad + dt * p.pm_dec_rad_yr
        return cls(stars, unit_vectors(ra, dec))

    def count(self, axis_i: Floats, v_mag: float) -> int:
        """Stars to `v_mag` in a field about a direction."""
        return int(np.sum((self.u_i @ axis_i > np.cos(FIELD_RAD)) & (self.stars.places.v_mag <= v_mag)))

    def near(self, axis_i: Floats, radius_rad: float, v_mag: float) -> SurveyedStars:
        """Stars to `v_mag` within a radius of a direction."""
        return self.stars.take((self.u_i @ axis_i > np.cos(radius_rad)) & (self.stars.places.v_mag <= v_mag))


def _pointings(sky: _Sky, rate: float, settings: ScanSettings, rng: np.random.Generator) -> Rotation:
    """Attitudes (TRIES,) of frame c at the beginning of scans that are centred on stars, in any direction."""
    bright = np.flatnonzero(sky.stars.places.v_mag <= settings.v_mag)
    z = sky.u_i[rng.choice(bright, TRIES)]
    turned = np.cross(Z, z)
    turned *= (np.arccos(z[:, 2]) / np.linalg.norm(turned, axis=1))[:, None]
    roll = np.outer(rng.uniform(0.0, 2.0 * np.pi, TRIES), Z)
    middle = (Rotation.from_rotvec(turned) * Rotation.from_rotvec(roll)).inv()
    return _attitude(middle, rate, -0.5 * settings.duration_s)


def angles_to_bodies(epoch: Epoch, t_s: float, p_i: Floats, axes_i: Floats) -> Floats:
    """Angles (..., 3) of directions (..., 3) to the Sun, the Moon and the Earth's limb (negative: in front of
    the Earth), rad, from a satellite at `p_i` (3,), m, GCRS.
    """
    jd = epoch.tt_jd(np.array([t_s]))
    sun = -erfa.epv00(*jd)[0]["p"][0] * erfa.DAU - p_i
    moon = erfa.moon98(*jd)["p"][0] * erfa.DAU - p_i
    bodies = np.array([one / np.linalg.norm(one) for one in (sun, moon, -p_i)])
    angles = np.arccos(np.clip(axes_i @ bodies.T, -1.0, 1.0))
    return np.asarray(angles - [0.0, 0.0, np.arcsin(WGS84.semi_major_m / np.linalg.norm(p_i))])


def _check_reach(orbit: Orbit, first_s: float, last_s: float) -> None:
    """`ValueError` where an orbit would be continued too far."""
    begin, end = orbit.span_s
    if first_s >= begin - MOST_CONTINUED_S and last_s <= end + MOST_CONTINUED_S:
        return
    utc = [str(one)[:16] for one in orbit.epoch.utc_from_seconds(np.array([first_s, last_s, begin, end]))]
    raise ValueError(
        f"scans are asked for from {utc[0]} to {utc[1]}, the orbit covers {utc[2]} to {utc[3]} and is "
        f"continued by {MOST_CONTINUED_S / 86400.0:.0f} days at most; give another orbit or time"
    )


def _states(orbit: Orbit, t_s: Floats) -> tuple[Floats, Floats]:
    """Positions and velocities (N, 3), GCRS, at increasing instants; beyond the nodes under gravity."""
    try:
        return orbit.states_i(t_s)
    except OrbitGapError:
        pass
    t0 = float(np.clip(t_s[0], *orbit.span_s))
    state = np.concatenate([one[0] for one in orbit.states_i(np.array([t0]))])
    parts = []
    for own in (t_s[t_s < t0][::-1], t_s[t_s >= t0]):
        if len(own):
            flown = solve_ivp(acceleration, (t0, float(own[-1])), state, "DOP853", own, rtol=1e-9, atol=1e-3)
            parts.append(flown.y.T if own[0] >= t0 else flown.y.T[::-1])
    states = np.concatenate(parts)
    return states[:, :3], states[:, 3:]


def _candidate(
    name: str,
    cameras: ScanCameras,
    sky: _Sky,
    state: tuple[float, Floats, Floats],
    rate_rad_s: float,
    settings: ScanSettings,
    rng: np.random.Generator,
) -> tuple[PlannedScan, StripSightings] | None:
    """A pointing that is clear of Sun, Moon and Earth from its beginning to its end."""
    t, p_i, _ = state
    least = np.radians([settings.sun_deg, settings.moon_deg, settings.earth_deg])
    tried = _pointings(sky, rate_rad_s, settings, rng)
    middles = _attitude(tried, rate_rad_s, 0.5 * settings.duration_s).inv().apply(Z)
    axes = [_axes(_attitude(tried, rate_rad_s, turn), cameras.R_cs) for turn in (0.0, settings.duration_s)]
    away = angles_to_bodies(cameras.orbit.epoch, t, p_i, np.concatenate(axes)).min(axis=0)
    if not (clear := np.flatnonzero(np.all(away >= least, axis=1))).size:
        return None
    best = max(clear[:COMPARED].tolist(), key=lambda k: sky.count(middles[k], settings.v_mag))
    R_ci = tried[best]
    strip, counts = _strip(name, cameras, sky, state, (R_ci, rate_rad_s), settings)
    if strip is None:
        return None
    scan = PlannedScan(
        t_s=t,
        R_ci=R_ci,
        rate_rad_s=rate_rad_s,
        stars=counts[0],
        head_stars=counts[1],
        away_deg=np.degrees(away[best]),
    )
    return scan, strip


def _axes(R_ci: Rotation, R_cs: Rotation) -> Floats:
    """Optical axes (2, N, 3) of both cameras at attitudes (N,), GCRS."""
    return np.stack([R_ci.inv().apply(Z), (R_ci.inv() * R_cs).apply(Z)])


def _attitude(R_ci: Rotation, rate_rad_s: float, t: float | Floats) -> Rotation:
    """Attitude(s) of frame c, seconds after the beginning."""
    return Rotation.from_rotvec(np.multiply.outer(t, [0.0, -rate_rad_s, 0.0])) * R_ci


def _strip(
    name: str,
    cameras: ScanCameras,
    sky: _Sky,
    state: tuple[float, Floats, Floats],
    scan: tuple[Rotation, float],
    settings: ScanSettings,
) -> tuple[StripSightings | None, tuple[int, int]]:
    """The stars that cross the CCDs, with exposures of the star camera; None where either sees too few."""
    (t0, p_i, v_i), (R_ci, rate), epoch = state, scan, cameras.orbit.epoch
    year = float(epoch.julian_year(np.array([t0]))[0])
    step, middle = 1.0 / settings.exposures_hz, _attitude(R_ci, rate, 0.5 * settings.duration_s)
    t_stars: Floats = np.arange(-step, settings.duration_s + 1.5 * step, step, dtype=np.float64)
    covariance_s, n_head = _head_covariance(cameras, sky, state, middle, settings)
    half = 0.5 * sum(cameras.line.n_px(c) for c in range(cameras.line.n_ccds)) * cameras.line.pixel_rad
    reach = np.hypot(half, 0.5 * abs(rate) * settings.duration_s) + 0.01
    known = sky.near(middle.inv().apply(Z), reach, settings.v_mag)
    if covariance_s is None or not len(known.places.hip):
        return None, (0, n_head)
    u_i = apparent_star_directions(known.places, epoch, t0, p_i, v_i)
    rows = [_crossings(cameras.line, c, u_i, R_ci, rate, settings) for c in range(cameras.line.n_ccds)]
    star, ccd, sample, t = (np.concatenate(part) for part in zip(*rows))
    if len(star) < 2:
        return None, (len(star), n_head)
    u_c = _attitude(R_ci, rate, t).apply(u_i[star])
    stars = GroundSightings.of_stars(
        target_id=np.array(
            [f"{name}/HIP {hip}/{c}" for hip, c in zip(known.places.hip[star], ccd)], dtype=str
        ),
        ccd=ccd,
        xy_px=np.column_stack([sample, t]),
        t_s=t,
        u_c=u_c,
        u_i=u_i[star],
        cov_c=isotropic_covariance(u_c, settings.star_sigma_px * cameras.line.pixel_rad),
        cov_target_i=isotropic_covariance(u_i[star], known.sigma_at_rad(year)[star]),
    )
    R_c = _attitude(R_ci, rate, t_stars)
    strip = StripSightings(
        strip_id=name,
        exposures=tuple(exposure_without_stars(f"{name}/{k}", float(one)) for k, one in enumerate(t_stars)),
        ground=stars,
        R_oi_exposures=R_c,
        R_oi_targets=_attitude(R_ci, rate, t),
        attitudes=solved_attitudes(cameras.R_cs.inv() * R_c, np.tile(covariance_s, (len(t_stars), 1, 1))),
        noise=cameras.noise,
    )
    return strip, (len(np.unique(star)), n_head)


def _crossings(
    line: LineSensor, c: int, u_i: Floats, R_ci: Rotation, rate: float, settings: ScanSettings
) -> tuple[Ints, Ints, Floats, Floats]:
    """Stars (M,) that a CCD sees during the scan: row of `u_i`, CCD, sample, instant."""
    n, T = line.n_px(c), settings.duration_s
    t: Floats = np.full(len(u_i), 0.5 * T)
    for _ in range(5):  # a positive rate moves stars towards -x
        sample, ahead_px = line.samples_from_directions(c, _attitude(R_ci, rate, t).apply(u_i))
        later = t + np.nan_to_num(ahead_px, nan=1e9) * line.pixel_rad / rate
        t = np.asarray(np.clip(later, -T, 2.0 * T), dtype=np.float64)
    on_ccd = (sample >= 0.0) & (sample <= n - 1.0) & (np.abs(ahead_px) < 1.0)
    seen = on_ccd & (t >= 0.0) & (t <= T)
    rows = np.flatnonzero(seen)
    return rows, np.full(len(rows), c), sample[rows], t[rows]


def _head_covariance(
    cameras: ScanCameras,
    sky: _Sky,
    state: tuple[float, Floats, Floats],
    R_ci: Rotation,
    settings: ScanSettings,
) -> tuple[Floats | None, int]:
    """Covariance (3, 3) of one exposure's attitude, axes of s, from the catalogue's stars, or as the head
    states it; number of the stars.
    """
    if not isinstance(cameras.star, StarCamera):
        return cameras.star, 0
    t, p_i, v_i = state
    R_si = cameras.R_cs.inv() * R_ci
    places = sky.near(R_si.inv().apply(Z), cameras.star.field_radius_rad, settings.head_v_mag).places
    u_s = R_si.apply(apparent_star_directions(places, cameras.orbit.epoch, t, p_i, v_i)).reshape(-1, 3)
    u_s = u_s[cameras.star.contains(cameras.star.pixels_from_directions(u_s))]
    sigma = settings.head_sigma_px * cameras.star.pixel_m / cameras.star.focal_m
    information = np.sum(np.eye(3) - u_s[:, :, None] * u_s[:, None, :], axis=0) / sigma**2
    if len(u_s) < 3:
        return None, len(u_s)
    return np.linalg.inv(information), len(u_s)


def _covariance(F: Floats, prior: Floats, errors: CalibrationSettings) -> Floats:
    """Covariance (3, 3) of theta; a large one where an axis is not observable."""
    limit = errors.sigma_observable_rad
    solution = solve_total(F, np.zeros(len(F)), prior, sigma_observable_rad=limit)
    blind = solution.unobservable
    return np.asarray(solution.covariance + limit**2 * blind.T @ blind)


def _greedy(
    F: Floats, prior: Floats, weight: Floats, count: int, errors: CalibrationSettings
) -> tuple[list[int], Floats]:
    """Candidates in the order in which they make the weighted variance smallest, and sigmas (count, 3)."""
    total, chosen, sigmas = np.zeros(F.shape[1:]), list[int](), []
    for _ in range(count):
        left = [k for k in range(len(F)) if k not in chosen]
        variances = [np.diag(_covariance(total + F[k], prior, errors)) for k in left]
        best = int(np.argmin([weight @ variance for variance in variances]))
        chosen.append(left[best])
        total = total + F[left[best]]
        sigmas.append(np.sqrt(variances[best]))
    return chosen, np.array(sigmas)


def _at_random(
    pairs: InformationPairs, prior: Floats, count: int, errors: CalibrationSettings, rng: np.random.Generator
) -> Floats:
    """Median 1-sigma (3,) of `count` candidates at random."""
    draws = [rng.permutation(len(pairs.names))[:count] for _ in range(25)]
    variances = [np.diag(_covariance(pairs.F[rows].sum(axis=0), prior, errors)) for rows in draws]
    return np.asarray(np.sqrt(np.median(variances, axis=0)))
