"""Contribution of each physical effect: the installation matrix's error with the effect omitted from the
processing.

    python benchmarks/ablation.py [--out docs/ablation.md]

Strips are made at the level of vectors with every effect present and without noise; then they are calibrated
with one effect omitted at a time. The result is the error that a program without this effect makes. The
star sky is Hipparcos to V = 6.5, the Earth's orientation the IERS tables', the geoid EGM96, the estimator
`calib.calibration.calibrate` with its defaults.
"""

from __future__ import annotations

import argparse
import datetime
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import erfa
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from boresight.calib.calibration import calibrate_strips
from boresight.calib.estimate import InstallationEstimate
from boresight.calib.settings import CalibrationSettings
from boresight.geometry.attitude import AttitudeTrack
from boresight.geometry.constants import ARCSEC, DAY_S, GM_EARTH, SPEED_OF_LIGHT, WGS84
from boresight.geometry.earth_orientation import EarthOrientationTable, bundled_earth_orientation
from boresight.geometry.earth_rotation import EarthRotation
from boresight.geometry.epoch import Epoch
from boresight.geometry.geodesy import ecef_from_geodetic, geodetic_from_ecef
from boresight.geometry.geoid import egm96
from boresight.geometry.groundlight import LightEffects, apparent_ground_directions
from boresight.geometry.installation import deviation_from_theta, theta_between
from boresight.geometry.line_camera import Ccd, LineCamera
from boresight.geometry.orbit import Orbit
from boresight.geometry.pushbroom import Pushbroom, RowClock
from boresight.geometry.sightings import GroundSightings, StarSightings, StripSightings, isotropic_covariance
from boresight.geometry.starlight import StarPlaces, apparent_star_directions
from boresight.geometry.terrain import ConstantHeight
from boresight.simulator.cameras import star_camera
from boresight.simulator.scenario import StarCameraSettings
from boresight.star_id.catalogue import hipparcos_stars

Array = NDArray[np.float64]

PASSES, TARGETS, LINES, PERIOD_S, TDI = 16, 24, 26_000, 6.6e-5, 32
EXPOSURES_S = -0.5 + 0.2 * np.arange(14)  # around a strip from 0 to 1.72 s
SIGMA_S, SIGMA_C_PX = 0.06 * 6.4e-6 / 0.1, 0.3
STAR_CAMERA = star_camera(StarCameraSettings())  # Table 2
R_CS = Rotation.from_euler("zx", [37.0, 165.0], degrees=True)  # the star camera looks 15 deg off the zenith
R_CS0 = deviation_from_theta(np.array([0.003, 0.002, 0.001])).inv() * R_CS  # the paper's (28) away
SETTINGS = CalibrationSettings(robust=False)


@dataclass(frozen=True)
class Starlight:
    """Which effects on the stars' directions are taken into account."""

    space_motion: bool = True
    parallax: bool = True
    deflection: bool = True
    earth_velocity: bool = True
    orbit_velocity: bool = True


@dataclass(frozen=True)
class Processing:
    """One way to process the strips; the default leaves nothing out."""

    stars: Starlight = Starlight()
    ground: LightEffects = field(default_factory=LightEffects)
    eop: Callable[[EarthOrientationTable], EarthOrientationTable] = lambda table: table
    heights_above_geoid: bool = True  # targets' heights are taken for what they are
    attitude: str = "interpolated"  # or "nearest", "nearest with nominal rate"
    row_shift_s: float = 0.0  # rows taken to be so much later than they are


@dataclass(frozen=True)
class Pass:
    """One strip as it really was."""

    name: str
    epoch: Epoch
    eop: EarthOrientationTable
    orbit: Orbit
    attitude: AttitudeTrack  # of the truth, exposures every 10 ms
    model: Pushbroom
    ccd: NDArray[np.int64]
    xy_px: Array
    lat: Array
    lon: Array
    height_m: Array  # above the ellipsoid


def make_pass(number: int, rng: np.random.Generator) -> Pass:
    """A date in 2024, a place, a direction of flight and a roll angle: all different from pass to pass."""
    date = datetime.datetime(2024, 1, 5) + datetime.timedelta(days=22.7 * number, hours=7.3 * number)
    epoch, eop = Epoch.from_utc(date.isoformat(timespec="seconds")), bundled_earth_orientation()
    earth = EarthRotation.over(epoch, -40.0, 60.0, eop)
    orbit = _orbit(epoch, earth, rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.0, 2.0 * np.pi))
    t_s = np.arange(-1.0, 3.0, 0.01)
    wave = (
        12.0 * ARCSEC * np.sin(2.0 * np.pi * t_s[:, None] / rng.uniform(3.0, 7.0, 3) + rng.uniform(0, 6, 3))
    )
    roll = rng.uniform(-25.0, 25.0)
    R_co = Rotation.from_rotvec(wave) * Rotation.from_euler("x", roll, degrees=True)
    attitude = AttitudeTrack(t_s, R_CS.inv() * R_co * orbit.R_oi(t_s), orbit)
    model = Pushbroom(
        camera=_camera(),
        rows=RowClock(0.0, PERIOD_S),
        orbit=orbit,
        earth=earth,
        attitude=attitude,
        R_cs=R_CS,
        effects=LightEffects(),
    )
    ccd = rng.integers(0, 4, TARGETS)
    xy = np.column_stack([rng.uniform(0.0, 6143.0, TARGETS), rng.uniform(0.0, LINES, TARGETS)])
    heights = rng.uniform(0.0, 1500.0, TARGETS)
    p_e = np.vstack(
        [
            model.ground_points(int(k), x[:1], x[1:], ConstantHeight(float(h)))
            for k, x, h in zip(ccd, xy, heights)
        ]
    )
    lat, lon, h = geodetic_from_ecef(p_e, WGS84)
    return Pass(f"pass{number:02d}", epoch, eop, orbit, attitude, model, ccd, xy, lat, lon, h)


def _orbit(epoch: Epoch, earth: EarthRotation, node: float, along: float) -> Orbit:
    """Sun-synchronous, 530 km, as a receiver gives it: ITRF at 1 Hz."""
    t_s, radius, tilt = np.arange(-30.0, 50.0), 6_908e3, np.radians(97.5)
    rate = np.sqrt(GM_EARTH / radius**3)
    c, s, zero = np.cos(rate * t_s + along), np.sin(rate * t_s + along), np.zeros_like(t_s)
    turn = Rotation.from_euler("xz", [tilt, node])
    p = turn.apply(radius * np.stack([c, s, zero], axis=-1))
    v = turn.apply(radius * rate * np.stack([-s, c, zero], axis=-1))
    inertial = Orbit(
        epoch=epoch, t_s=t_s, positions_m=p, velocities_m_s=v, frame="GCRF", degree=7, earth=earth
    )
    return Orbit(
        epoch=epoch,
        t_s=t_s,
        positions_m=inertial.positions_e(t_s),
        velocities_m_s=inertial.velocities_e(t_s),
        frame="ITRF",
        degree=7,
        earth=earth,
    )


def _camera() -> LineCamera:
    ccds = [
        Ccd(
            n_px=6144,
            y_first_m=-0.122 + k * 0.0604,
            x_offset_m=0.001 * (-1) ** k,
            rotation_rad=0.0,
            pixel_m=1e-5,
            principal_sample=3067.0,
        )
        for k in range(4)
    ]
    return LineCamera(10.0, tuple(ccds), TDI)


def sightings(one: Pass, how: Processing, stars: StarPlaces) -> StripSightings:
    """What the pass looks like to a program that processes it in some way."""
    earth = EarthRotation.over(one.epoch, -40.0, 60.0, how.eop(one.eop))
    orbit = replace(one.orbit, earth=earth)
    exposures = tuple(_exposure(one, orbit, how, stars, k, float(t)) for k, t in enumerate(EXPOSURES_S))
    t_true = one.model.instants(one.xy_px[:, 1])
    t_row = t_true + how.row_shift_s
    undulation = 0.0 if how.heights_above_geoid else egm96().undulation_m(one.lat, one.lon)
    p_e = ecef_from_geodetic(one.lat, one.lon, one.height_m - undulation, WGS84)
    u_i, range_m = apparent_ground_directions(p_e, t_row, orbit, earth, how.ground)
    t_attitude, R_oi = t_row, orbit.R_oi(t_row)
    if how.attitude != "interpolated":
        t_attitude = EXPOSURES_S[np.abs(t_row[:, None] - EXPOSURES_S).argmin(axis=1)]
        R_oi = R_oi if how.attitude == "nearest with nominal rate" else orbit.R_oi(t_attitude)
    u_c, cov_c = np.empty((TARGETS, 3)), np.empty((TARGETS, 3, 3))
    for k in range(4):
        here = one.ccd == k
        u_c[here] = one.model.camera.directions_from_pixels(k, one.xy_px[here, 0])
        J = one.model.pixel_jacobian(k, *one.xy_px[here].T)
        cov_c[here] = SIGMA_C_PX**2 * J @ np.swapaxes(J, 1, 2)
    R_ie = earth.matrices_ie(t_row)
    ground = GroundSightings(
        target_id=np.array([f"{one.name}t{k:02d}" for k in range(TARGETS)]),
        ccd=one.ccd,
        xy_px=one.xy_px,
        t_s=t_attitude,
        u_c=u_c,
        u_i=u_i,
        cov_c=cov_c,
        range_m=range_m,
        v_rel_i=np.einsum("nij,nj->ni", R_ie, orbit.velocities_e(t_row)),
        cov_target_i=np.tile(0.01 * np.eye(3), (TARGETS, 1, 1)),
        earth_i=np.zeros((TARGETS, 3, 3)),
    )
    return StripSightings(
        strip_id=one.name,
        exposures=exposures,
        ground=ground,
        R_oi_exposures=orbit.R_oi(EXPOSURES_S),
        R_oi_targets=R_oi,
    )


def _exposure(one: Pass, orbit: Orbit, how: Processing, stars: StarPlaces, k: int, t: float) -> StarSightings:
    when = np.array([t])
    R_si = one.attitude.R_si(when)[0]
    p, v = one.orbit.states_i(when)
    axis_i = R_si.inv().apply([0.0, 0.0, 1.0])
    near = apparent_star_directions(stars, one.epoch, when, p, v) @ axis_i > np.cos(np.radians(12.5))
    around = stars.take(near)
    u_s = R_si.apply(apparent_star_directions(around, one.epoch, when, p, v))
    xy = STAR_CAMERA.pixels_from_directions(u_s)
    seen = STAR_CAMERA.contains(xy)
    u_i = star_directions(around.take(seen), one.epoch, t, orbit, how.stars)
    return StarSightings(
        exposure_id=f"{one.name}e{k:02d}",
        t_s=t,
        hip=around.hip[seen],
        xy_px=xy[seen],
        u_s=u_s[seen],
        u_i=u_i,
        cov_s=isotropic_covariance(u_s[seen], SIGMA_S),
    )


def star_directions(stars: StarPlaces, epoch: Epoch, t: float, orbit: Orbit, how: Starlight) -> Array:
    """Catalogue directions with some effects; with all of them those of `geometry.starlight` (a check is
    made).
    """
    when = np.array([t])
    p, v = orbit.states_i(when)
    pv = np.zeros(1, dtype=erfa.dt_pv)
    pv["p"], pv["v"] = p, v
    observer = erfa.apcs13(*epoch.tt_jd(when), pv)[0]
    years = float(epoch.julian_year(when)[0]) - stars.epoch_jyear if how.space_motion else 0.0
    parallax = np.maximum(stars.parallax_arcsec, 0.0) * how.parallax
    motion = (stars.pm_ra_rad_yr, stars.pm_dec_rad_yr, parallax, stars.radial_velocity_km_s)
    u = erfa.pmpx(stars.ra_rad, stars.dec_rad, *motion, years, observer["eb"])
    if how.deflection:
        u = erfa.ldsun(u, observer["eh"], observer["em"])
    orbital = v[0] / SPEED_OF_LIGHT
    beta = how.earth_velocity * (observer["v"] - orbital) + how.orbit_velocity * orbital
    u = erfa.ab(u, beta, observer["em"], np.sqrt(1.0 - beta @ beta))
    if how == Starlight():
        assert np.abs(u - apparent_star_directions(stars, epoch, when, p, v)).max() < 1e-14
    return np.asarray(u)


LEFT_OUT: dict[str, Processing] = {
    "nothing": Processing(),
    "stars: all aberration": Processing(stars=Starlight(earth_velocity=False, orbit_velocity=False)),
    "stars: aberration by the Earth's velocity": Processing(stars=Starlight(earth_velocity=False)),
    "stars: aberration by the orbital velocity": Processing(stars=Starlight(orbit_velocity=False)),
    "stars: space motion since 1991.25": Processing(stars=Starlight(space_motion=False)),
    "stars: parallax": Processing(stars=Starlight(parallax=False)),
    "stars: light deflection by the Sun": Processing(stars=Starlight(deflection=False)),
    "ground: aberration": Processing(ground=LightEffects(aberration=False)),
    "stars: aberration by the orbital velocity; ground: aberration": Processing(
        stars=Starlight(orbit_velocity=False), ground=LightEffects(aberration=False)
    ),
    "stars: all aberration, parallax, deflection; ground: all three (the paper as printed)": Processing(
        stars=Starlight(parallax=False, deflection=False, earth_velocity=False, orbit_velocity=False),
        ground=LightEffects(light_time=False, aberration=False, refraction=False),
    ),
    "ground: light time": Processing(ground=LightEffects(light_time=False)),
    "ground: refraction": Processing(ground=LightEffects(refraction=False)),
    "rows: motion since the nearest exposure": Processing(attitude="nearest"),
    "rows: motion other than the nominal orbital rate": Processing(attitude="nearest with nominal rate"),
    f"rows: half the exposure over {TDI} TDI stages": Processing(row_shift_s=0.5 * TDI * PERIOD_S),
    "Earth: UT1 - UTC": Processing(eop=lambda e: replace(e, ut1_utc_s=np.zeros_like(e.ut1_utc_s))),
    "Earth: polar motion": Processing(
        eop=lambda e: replace(e, xp_rad=np.zeros_like(e.xp_rad), yp_rad=np.zeros_like(e.yp_rad))
    ),
    "Earth: dX and dY": Processing(
        eop=lambda e: replace(e, dx_rad=np.zeros_like(e.dx_rad), dy_rad=np.zeros_like(e.dy_rad))
    ),
    "heights: geoid undulation (EGM96)": Processing(heights_above_geoid=False),
}


def errors(passes: list[Pass], how: Processing, stars: StarPlaces) -> tuple[Array, Array, float]:
    """Error of theta: (P, 3) from each pass alone, (3,) from all together, arcsec; and chi2 per degree of
    freedom.
    """
    strips = [sightings(one, how, stars).later(n * DAY_S) for n, one in enumerate(passes)]
    alone = np.array([_error([strip])[0] for strip in strips])
    together, chi2 = _error(strips)
    return alone, together, chi2


def _error(strips: list[StripSightings]) -> tuple[Array, float]:
    found = calibrate_strips(strips, R_CS0, SETTINGS)
    assert isinstance(found, InstallationEstimate), found
    return theta_between(found.R_cs, R_CS) / ARCSEC, found.chi2 / found.dof


def report(rows: dict[str, tuple[Array, Array, float]]) -> str:
    """The table of docs/ablation.md: what each effect adds to what is left when nothing is left out."""
    text = _TEXT.format(passes=PASSES, targets=TARGETS, exposures=len(EXPOSURES_S))
    lines = [text, "| neglected | one pass, rms: X | Y | Z | all passes: X | Y | Z |"]
    lines.append("| --- | --: | --: | --: | --: | --: | --: |")
    base_alone, base_together, _ = rows["nothing"]
    for name, (alone, together, _) in rows.items():
        if name != "nothing":
            alone, together = alone - base_alone, together - base_together
        rms = np.sqrt((alone**2).mean(axis=0))
        lines.append(f"| {name} | {' | '.join(_figure(value) for value in (*rms, *together))} |")
    return "\n".join(lines) + "\n" + _NOTES


def _figure(value: float) -> str:
    digits = 1 if abs(value) >= 10.0 else 2 if abs(value) >= 1.0 else 3 if abs(value) >= 0.01 else 4
    return f"{value:.{digits}f}" if abs(value) >= 5e-5 else "0"


_TEXT = """# What each effect is worth

Error of the installation matrix, in arc-seconds about the axes of the remote-sensing camera, that comes from
neglecting one effect in the processing of strips in which all are present. No noise was added: the table
shows the effects themselves. The paper reports 0.01″.

Made by `python benchmarks/ablation.py --out docs/ablation.md`: {passes} passes over all of 2024, anywhere on
a sun-synchronous orbit at 530 km, roll angles within ±25°, {targets} targets a strip at heights of 0 to 1500
m, {exposures} star exposures at 5 Hz with the real Hipparcos sky to V = 6.5, an attitude that oscillates by
12″, the star camera 15° off the zenith. "One pass" calibrates each strip alone; "all passes" is the joint
estimate, in which effects that change sign from place to place partly cancel. The orbit is given in ITRF, as
a receiver gives it, and the estimator carries its usual unknowns (position 2 m, clock 0.1 ms, vibration 0.1″,
distortion 0.3 px), which take up a little of each effect.

The first line is what is left with nothing neglected, the cubic through the star exposures; it has been taken
off the other lines.
"""

_NOTES = """
How to read it:

* The aberration of the stars by the orbital velocity and that of the ground are one velocity seen by two
  cameras. With the star camera near the zenith both rotate the matrix the same way, and a program without
  either is wrong by their sum, 10″ in pitch, the same in every pass: no amount of data averages it out.
* The aberration by the Earth's velocity changes with the season and with the place on the orbit. A campaign
  spread over a year averages some of it out; a campaign of a week does not.
* Earth orientation matters although the orbit is Earth-fixed: satellite and targets rotate together against
  the stars, 15″ for each second of UT1 - UTC, which was within 0.06 s in 2024. dX and dY were 0.6 mas at
  most.
* Each row has its own instant: the attitude rotates by 0.22″ a millisecond, and what the nearest exposure
  says is up to 100 ms old. Z, which only the spread of the targets in the field tells, suffers most. Half a
  TDI exposure is 8 m along the track.
* A missing geoid hardly shows at nadir and grows with the tangent of the roll angle, as refraction does.
"""


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--out", type=Path)
    out = parser.parse_args().out
    rng = np.random.default_rng(2024)
    passes = [make_pass(k, rng) for k in range(PASSES)]
    catalogue = hipparcos_stars(6.5)
    stars = catalogue.places.take(catalogue.usable_for_calibration)
    rows = {}
    for name, how in LEFT_OUT.items():
        rows[name] = errors(passes, how, stars)
        alone, together, chi2 = rows[name]
        rms = np.sqrt((alone**2).mean(axis=0))
        print(
            f"{name:50s} one pass {np.round(rms, 4)}  all {np.round(together, 4)}  chi2/dof {chi2:.3g}",
            flush=True,
        )
    if out is not None:
        out.write_text(report(rows), encoding="utf-8")


if __name__ == "__main__":
    main()
