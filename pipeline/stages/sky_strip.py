"""From one strip of the sky to named stars, and from these to directions (`GroundSightings`).

    raw strip -> detections with places (`find_sky_stars`, kept on disk)
    detections, attitudes, R_cs -> vote for the mounting, names (`name_sky_stars`, computed each time)
    place -> look direction u_c (sample) and instant (line); catalogue -> apparent direction u_i

The motion of the image points, and with it the shape of a trace, comes from the star camera's own attitudes:
a dump states no guidance.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.geometry.attitude import AttitudeTrack, ConstantRate, Interpolation
from boresight.geometry.constants import WGS84
from boresight.geometry.epoch import Epoch
from boresight.geometry.geodesy import unit_vectors
from boresight.geometry.line_camera import LineSensor, end_looks
from boresight.geometry.orbit import Orbit
from boresight.geometry.pushbroom import RowClock
from boresight.geometry.sightings import GroundSightings, isotropic_covariance
from boresight.geometry.starlight import SurveyedStars, apparent_star_directions
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.strip_table import Strip
from boresight.pipeline.stages.strip import MatchedTargets, measured_points
from boresight.records.ledger import Entry, Kind, Reason, Subject
from boresight.records.record import Floats, Ints, Texts, array, inner, record, scalar
from boresight.star_id.strip_stars.find import StripMotion, StripStars, find_strip_stars
from boresight.star_id.strip_stars.fit import LEAST_GAIN
from boresight.star_id.strip_stars.settings import StripStarSettings
from boresight.star_id.strip_stars.strip_names import (
    Directions,
    NoRotation,
    StripField,
    name_stars,
    vote_for_rotation,
)

__all__ = [
    "NOT_STATED_PX",
    "NamedStars",
    "SkyTask",
    "as_matched",
    "find_sky_stars",
    "name_sky_stars",
    "sky_sightings",
    "strip_motion",
]

_NODES = 33  # lines at which the motion of the image points is given
NOT_STATED_PX = 1.0  # 1 sigma of what displaces a star beside the stated errors (set by hand)
_OF_STAGES = "check tdi_stages and time_of_row in remote_camera.toml"
_LEAST_SMEAR = 1.0  # rows from which TDI stages give a star another shape than the optics do
_AT_LEAST_GAIN = 1.1  # times the least gain: below it no noise was found
_SLOWEST = 0.05  # pixels a row: slower, a star stays for hundreds of rows
_FEWEST = 4  # stars that give a rotation of the mounting
# Margin around a strip's field, rad, within which catalogue stars are looked up: more than aberration and
# refraction.
_FIELD_MARGIN_RAD = 0.002


@record(kw_only=True)
class SkyTask:
    """One strip of the sky and everything that its detections depend on."""

    strip: Strip = scalar("images and times of the strip")
    camera: LineSensor = scalar("model of the remote-sensing camera")
    stages: int = scalar("TDI stages")
    bit_depth: int = scalar("of the raw images")
    orbit: Orbit = scalar("states around the strip")
    t_attitude_s: Floats = array("K", "exposures around the strip, TAI seconds since the dump's epoch")
    R_si: Rotation = array("K", "their attitudes, GCRS to frame s of the reference head")
    covariance_c: Floats = array("K, 3, K, 3", "of their errors, axes of c by the pre-launch matrix, rad²")
    R_cs0: Rotation = scalar("pre-launch installation matrix")
    settings: StripStarSettings = scalar("thresholds of detection and identification")
    carrier: str = scalar("head whose attitudes these are")
    interpolation: Interpolation = scalar("between the attitudes", default="lagrange")

    item = inner[Entry]("strip.item", "what is processed, without a reason")
    epoch = inner[Epoch]("orbit.epoch", "zero of all instants")

    @property
    def nominal(self) -> ConstantRate:
        """The scan: the constant rate nearest to the star camera's attitudes, axes of s."""
        return ConstantRate.fitted(self.t_attitude_s, self.R_si)

    @property
    def track(self) -> AttitudeTrack:
        """Attitude of the star camera against time."""
        return AttitudeTrack(self.t_attitude_s, self.R_si, self.nominal, interpolation=self.interpolation)

    def instants(self, line: Floats) -> Floats:
        """Middle of the exposure of lines (N,), TAI seconds since the epoch."""
        period = self.strip.row_period_s
        delay = self.camera.delay_to_middle_s(period)
        return RowClock(self.strip.t_first_row_s, period).instant(line) + delay


@record
class NamedStars:
    """What became of one strip of the sky."""

    strip_id: str
    found: StripStars  # all detections
    rows: Ints  # (N,) those with names
    places: SurveyedStars  # (N,) the same stars in the catalogue
    probability_wrong: Floats  # (N,) of each name
    omissions: tuple[Entry, ...]

    @property
    def names(self) -> Texts:
        """(N,) names of the stars, with that of the catalogue."""
        return np.array([f"{self.places.name} {n}" for n in self.places.places.hip.tolist()], dtype=str)

    def take(self, names: Ints) -> NamedStars:
        """Some of the names (M,), all detections."""
        rows, places, wrong = self.rows[names], self.places.take(names), self.probability_wrong[names]
        return replace(self, rows=rows, places=places, probability_wrong=wrong)


def find_sky_stars(task: SkyTask) -> StripStars | Entry:
    """Detections in a strip of the sky, or why it cannot be one that is evaluated."""
    motion = strip_motion(task)
    if (refused := _refused(task, motion)) is not None:
        return refused
    saturation = task.settings.saturation_dn or 2.0**task.bit_depth - 1.0
    try:
        found = find_strip_stars(task.strip.images, motion, task.settings, saturation)
    except RawDataError as error:
        return Entry(task.strip.subject, Reason.UNREADABLE, str(error), error.file)
    if not len(found.ccd):
        return task.item.because(Reason.NOT_IDENTIFIED, _without_stars(task, saturation))
    smear = float(motion.usual.smear_rows.max())
    if smear > _LEAST_SMEAR and found.gain_e_per_dn < _AT_LEAST_GAIN * LEAST_GAIN:
        reason = f"{task.stages} stages would smear its stars over {smear:.0f} rows; they are not"
        return task.item.because(Reason.OTHER_SMEAR, f"{reason}: {_OF_STAGES}")
    return found


def _without_stars(task: SkyTask, saturation_dn: float) -> str:
    """That a strip has no star, and the grey level of its middle where that is the same in every CCD."""
    images = task.strip.images
    pixels = sum(lines * samples for lines, samples in images.shapes.values())
    middles = [
        images.read(ccd, lines // 2, lines // 2 + 1, 0, samples)
        for ccd, (lines, samples) in images.shapes.items()
    ]
    levels = {int(level) for middle in middles for level in (middle.min(), middle.max())}
    if len(levels) > 1:
        return f"no star in its {pixels:.3g} pixels"
    (level,) = levels
    return f"grey level {level} throughout{', saturated' if level >= saturation_dn else ''}: no star in it"


def name_sky_stars(
    task: SkyTask,
    found: StripStars,
    survey: SurveyedStars,
    R_cs: Rotation,
    sigma_rad: Floats,
    *,
    known: bool,
    scatter_px: float,
) -> NamedStars:
    """Names of detections by a mounting and its 1-sigma (3,), rad, axes of c.

    With `known` the mounting is good to some pixels, so that each star is named by itself; else a vote must
    find it. `scatter_px` is the 1-sigma of what displaces one star against another: distortion, vibration.
    """
    seen = _directions(task, found, R_cs, scatter_px)
    stars, field = _field(task, survey, R_cs, sigma_rad, _spread(seen, scatter_px * task.camera.pixel_rad))
    theta: Floats = np.zeros(3)
    root: Floats = np.diag(np.asarray(sigma_rad, dtype=float))
    settings = task.settings
    if not known:
        voted = vote_for_rotation(seen, field, settings.brightest, settings.max_false_alarm_probability)
        if isinstance(voted, NoRotation):
            reason = _not_identified(task, found, field, R_cs, voted)
            omission, none = task.item.because(Reason.NOT_IDENTIFIED, reason), np.zeros(0, dtype=np.int64)
            return NamedStars(task.strip.strip_id, found, none, stars.take(none), np.zeros(0), (omission,))
        theta, root = voted.theta_rad, voted.theta_root
    named = name_stars(
        seen,
        field,
        theta,
        root,
        magnitude_error=settings.magnitude_error,
        max_name_error=settings.max_name_error,
    )
    single, sharp = stars.single[named.star], ~(found.blended | found.saturated)[named.row]
    sure = named.probability_wrong < settings.max_name_error
    use = np.flatnonzero(single & sharp & sure)
    omitted = []
    for k in np.flatnonzero(~(single & sharp & sure)).tolist():
        reason = Reason.NOT_ONE_STAR if not single[k] else Reason.NOT_A_SHARP_STAR
        detail = reason.value
        if single[k] and sharp[k]:
            reason, place = Reason.NAME_UNSURE, seen.take(named.row[k : k + 1])
            detail = _unsure(named.probability_wrong[k], place, root, scatter_px, task.camera.pixel_rad)
        name, ccd = f"{stars.name} {stars.places.hip[named.star[k]]}", int(found.ccd[named.row[k]])
        subject = Subject(Kind.STAR, strip=task.strip.strip_id, ccd=ccd, id=name)
        omitted.append(Entry(subject, reason, detail))
    if not len(use):
        reason = f"none of its {len(found.ccd)} detections is a star of {stars.name} that can be used"
        omitted.append(task.item.because(Reason.NO_TARGET, reason))
    return NamedStars(
        strip_id=task.strip.strip_id,
        found=found,
        rows=named.row[use],
        places=stars.take(named.star[use]),
        probability_wrong=named.probability_wrong[use],
        omissions=tuple(omitted),
    )


def sky_sightings(task: SkyTask, named: NamedStars) -> GroundSightings:
    """Directions of named stars: measured by the camera, and computed from the catalogue."""
    found, J = named.found.take(named.rows), len(named.rows)
    t_s = task.instants(found.xy_px[:, 1])
    u_c, jacobian = np.zeros((J, 3)), np.zeros((J, 3, 2))
    period = task.strip.row_period_s
    rate_c = task.R_cs0.apply(task.nominal.omega_o)
    for ccd in np.unique(found.ccd).tolist():
        here = found.ccd == ccd
        u_c[here] = task.camera.directions_from_pixels(ccd, found.xy_px[here, 0])
        jacobian[here, :, 0] = task.camera.sample_jacobian(ccd, found.xy_px[here, 0])
    jacobian[:, :, 1] = np.cross(rate_c * period, u_c)  # later by a line, a star is rotated by minus this
    p_i, v_i = task.orbit.states_i(t_s)
    u_i: Floats = apparent_star_directions(named.places.places, task.epoch, t_s, p_i, v_i)
    sigma = named.places.sigma_at_rad(float(task.epoch.julian_year(t_s[0]))) if J else np.zeros(0)
    return GroundSightings.of_stars(
        target_id=named.names,
        ccd=found.ccd,
        xy_px=found.xy_px,
        t_s=t_s,
        u_c=u_c,
        u_i=u_i,
        cov_c=jacobian @ found.cov_px @ np.swapaxes(jacobian, 1, 2),
        cov_target_i=isotropic_covariance(u_i, sigma),
    )


def as_matched(named: NamedStars) -> MatchedTargets:
    """The named stars as targets measured in a strip."""
    found = named.found.take(named.rows)
    places = found.ccd, found.xy_px, found.cov_px
    return measured_points(named.strip_id, named.names, *places, named.probability_wrong)


def strip_motion(task: SkyTask) -> StripMotion:
    """Motion of image points in the middle of each CCD, from the attitudes and the pre-launch matrix."""
    lines: Floats = np.linspace(0.0, max(task.strip.lines - 1.0, 1.0), _NODES, dtype=np.float64)
    track, count = task.track, task.camera.n_ccds
    rate, drift = np.zeros((count, _NODES)), np.zeros((count, _NODES))
    before, after = (task.R_cs0 * track.R_si(task.instants(lines + side)) for side in (-0.5, 0.5))
    turn = (after * before.inv()).as_matrix()
    for ccd in range(count):
        middle = 0.5 * (task.camera.n_px(ccd) - 1.0)
        u_c = task.camera.directions_from_pixels(ccd, np.array([middle]))[0]
        sample, across = task.camera.samples_from_directions(ccd, turn @ u_c)
        rate[ccd], drift[ccd] = -across, sample - middle
    return StripMotion(lines, rate, drift, task.stages)


def _refused(task: SkyTask, motion: StripMotion) -> Entry | None:
    """Why a strip cannot be one of the sky that is evaluated; None if it can."""
    t_s = task.instants(np.array([0.5 * (task.strip.lines - 1.0)]))
    p_i = task.orbit.states_i(t_s)[0][0]
    axis_i = (task.R_cs0 * task.track.R_si(t_s)).inv().apply([0.0, 0.0, 1.0])[0]
    height = float(np.linalg.norm(p_i))
    off_nadir = np.degrees(np.arccos(np.clip(-axis_i @ p_i / height, -1.0, 1.0)))
    limb = np.degrees(np.arcsin(min(WGS84.semi_major_m / height, 1.0)))
    usual, because = motion.usual, Reason.NOT_A_SKY_STRIP
    slowest = float(np.abs(usual.rate).min())
    if off_nadir < limb:
        reason = (
            f"kind is sky, but the camera looks at the Earth: {off_nadir:.1f} deg from nadir, the limb lies "
            f"at {limb:.1f} deg"
        )
    elif slowest < _SLOWEST:
        reason = f"its stars move {slowest:.3f} pixels a row along the stages, {_SLOWEST} are needed"
    elif (smear := float(usual.smear_rows.max())) <= task.settings.max_smear_rows:
        return None
    elif usual.rate[0] < 0.0:
        because = Reason.OTHER_SMEAR
        reason = f"its stars move against the motion of the charge, {smear:.0f} rows in {task.stages} stages"
        reason = f"{reason}: {_OF_STAGES}"
    else:
        reason = (
            f"a star's trace is {smear:.0f} rows long: it moves {usual.rate[0]:.2f} pixels a row over "
            f"{task.stages} stages; scan with the stages at a pixel a row, or with fewer of them"
        )
    return task.item.because(because, reason)


def _directions(
    task: SkyTask, found: StripStars, R_cs: Rotation, scatter_px: float, line: Floats | None = None
) -> Directions:
    """Detections as directions, with what displaces them; `line` (N,) instead of their own."""
    line = found.xy_px[:, 1] if line is None else line
    u_c = np.zeros((len(found.ccd), 3))
    for ccd in np.unique(found.ccd).tolist():
        here = found.ccd == ccd
        u_c[here] = task.camera.directions_from_pixels(ccd, found.xy_px[here, 0])
    t_s = task.instants(line)
    measured_px2 = np.trace(found.cov_px, axis1=1, axis2=2) / 2.0
    return Directions(
        u_c=u_c,
        R_ci=(R_cs * task.track.R_si(t_s)).as_matrix(),
        brightness=np.where(found.saturated, np.nan, -2.5 * np.log10(np.maximum(found.flux_dn, 1e-9))),
        attitude_c=task.track.errors_s(t_s, task.covariance_c),
        variance=(measured_px2 + scatter_px**2 + NOT_STATED_PX**2) * task.camera.pixel_rad**2,
    )


def _unsure(
    probability: float, seen: Directions, theta_root: Floats, scatter_px: float, pixel_rad: float
) -> str:
    """Why the name of one detection is not sure: the error that displaces it most."""
    sigma_px = {
        "noise of the star camera's attitudes": _largest_sigma(seen.by_attitude[0]) / pixel_rad,
        "1-sigma of the mounting": _largest_sigma(seen.by_rotation[0] @ theta_root) / pixel_rad,
        "look_distortion_px and vibration_arcsec of dump.toml": scatter_px,
    }
    error = max(sigma_px, key=lambda name: sigma_px[name])
    return (
        f"another star with a probability of {probability:.2g}: of the stated errors {error} displaces it "
        f"most, by {sigma_px[error]:.1f} px"
    )


def _largest_sigma(moved: Floats) -> float:
    """1-sigma along the major axis of a displacement (2, A) by A independent errors."""
    return float(np.linalg.svd(moved, compute_uv=False)[0]) if moved.size else 0.0


def _spread(seen: Directions, scatter_rad: float) -> Floats:
    """Mean covariance (2, 2) of what the attitudes' errors and the stated scatter displace, rad²."""
    moved = seen.by_attitude
    total = (moved @ np.swapaxes(moved, 1, 2)).sum(axis=0)
    return np.asarray(total / max(len(moved), 1) + scatter_rad**2 * np.eye(2))


def _field(
    task: SkyTask, survey: SurveyedStars, R_cs: Rotation, sigma_rad: Floats, spread: Floats
) -> tuple[SurveyedStars, StripField]:
    """The catalogue's stars that the strip may show, and the limits of the search."""
    strip, camera, settings = task.strip, task.camera, task.settings
    t_s = task.instants(np.array([0.5 * (strip.lines - 1.0)]))
    p_i, v_i = task.orbit.states_i(t_s)
    axis_i = (R_cs * task.track.R_si(t_s)).inv().apply([0.0, 0.0, 1.0])[0]
    half_swath = float(np.arccos(end_looks(camera)[:, 2].min()))  # of a pixel's line of sight from the axis
    duration = strip.lines * strip.row_period_s
    long = float(np.linalg.norm(task.nominal.omega_o)) * duration
    limit = np.maximum(settings.sigmas * np.asarray(sigma_rad, dtype=float), 1e-9)
    radius = half_swath + 0.5 * long + float(np.hypot(limit[0], limit[1])) + _FIELD_MARGIN_RAD
    unit_i = unit_vectors(survey.places.ra_rad, survey.places.dec_rad)
    near = survey.take(np.flatnonzero(unit_i @ axis_i > np.cos(radius + _FIELD_MARGIN_RAD)))
    u_i = apparent_star_directions(near.places, task.epoch, float(t_s[0]), p_i[0], v_i[0])
    return near, StripField(
        u_i=u_i,
        v_mag=near.places.v_mag,
        limit_rad=limit,
        spread=spread,
        slack_rad=2.0 * NOT_STATED_PX * camera.pixel_rad,
        strip_area=2.0 * half_swath * long,
    )


def _not_identified(
    task: SkyTask, found: StripStars, field: StripField, R_cs: Rotation, voted: NoRotation
) -> str:
    """One sentence on why no rotation was found: the likely cause, with the numbers."""
    per_deg2 = len(found.ccd) / (field.strip_area * np.degrees(1.0) ** 2)
    counts = (
        f"{len(found.ccd)} detections, {len(field.u_i)} catalogue stars around; at most {voted.stars} agree "
        f"with one rotation of the mounting"
    )
    mirrored = _directions(task, found, R_cs, 0.0, line=task.strip.lines - 1.0 - found.xy_px[:, 1])
    settings = task.settings
    if not isinstance(
        vote_for_rotation(mirrored, field, settings.brightest, settings.max_false_alarm_probability),
        NoRotation,
    ):
        return f"its rows run against the attitudes: {counts}, but with the order of rows reversed many do"
    if per_deg2 > settings.max_stars_per_deg2:
        return f"too crowded, {per_deg2:.0f} detections a square degree (the Milky Way?): {counts}"
    if min(voted.detections, len(field.u_i)) < _FEWEST:
        return f"too few stars: {counts}; {_FEWEST} are needed"
    return f"its stars are not those of the catalogue: {counts}"
