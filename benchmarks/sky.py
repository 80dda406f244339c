"""Strips of the sky from raw pixels: the matrix without any ground, with a tracker's attitudes, names in
strips of noise, and the places of stars.

    python benchmarks/sky.py missions [--seeds 12] [--cameras mini] [--scans 2] [--ground 0]
    python benchmarks/sky.py trackers [--seeds 8]
    python benchmarks/sky.py noise [--seeds 40]
    python benchmarks/sky.py places [--seeds 1]

`missions`: mounting off by the paper's equation (28), all errors of its Table 1 on. Each scan looks at one of
the fields richest in Hipparcos stars that both cameras see past the Earth. The paper's cameras take 3 minutes
of CPU a mission. `trackers`: one scan with attitudes of 1, 1 and 8 arcsec in place of star images, of a head
that looks where the paper's star camera looks, and of one mounted at random, whose 8 arcsec move stars by 3
pixels. `noise`: strips of noise, half of them with hot columns, and what is named in them. `places`: errors
of stars for rates of scan and numbers of TDI stages over the Cramér-Rao bound of the star as it was rendered
(place, charge and background unknown); stars with another within 16 px and the smear are left out.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from record import ROOT, exit_status, head, judge_largest, judge_nees, judge_share
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from scipy.special import ndtr

sys.path.insert(0, str(ROOT / "tests" / "pipeline" / "faults"))

from fault_dumps import TRACKER, TrialHead, write_heads

from boresight.calib.estimate import InstallationEstimate
from boresight.geometry.constants import ARCSEC
from boresight.geometry.earth_orientation import bundled_earth_orientation
from boresight.geometry.earth_rotation import EarthRotation
from boresight.geometry.epoch import Epoch
from boresight.geometry.installation import theta_between
from boresight.geometry.orbit import Orbit
from boresight.pipeline.calibration.calibrate import DumpCalibration, calibrate_dump
from boresight.pipeline.errors import DataNotSufficientError, Omission
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.files.dump_writer import write_dump
from boresight.pipeline.files.scenario_file import fly
from boresight.pipeline.run.settings import Settings, calibration_settings
from boresight.pipeline.stages.cached import StageRunner
from boresight.pipeline.stages.head import sight_head
from boresight.pipeline.stages.sky_side import find_in_sky_strips
from boresight.pipeline.stages.sky_strip import find_sky_stars, name_sky_stars
from boresight.simulator.cameras import installation_of_scenario
from boresight.simulator.mission_records import Mission
from boresight.simulator.motion import flown_orbit
from boresight.simulator.scenario import Scenario, SkyScan, SkyStripSettings, builtin_scenario
from boresight.star_id.strip_stars.find import StripMotion, StripStars, find_strip_stars
from boresight.star_id.strip_stars.settings import StripStarSettings
from boresight.star_id.whole_catalogue import all_hipparcos

Array = NDArray[np.float64]

FIELD_DEG = 1.3  # a strip shows 1.4 x 1.5 degrees
USABLE_V = (5.0, 9.0)  # neither saturated nor below SNR 8 at the paper's cameras
FIELDS = 24
CLEAR_DEG = 75.0  # both axes from nadir: the limb lies at 67.4
RATE_HZ = 2.5  # of the star camera, half the paper's: half the time to render
APART_S = 30.0
NOISE_PEAKS = 30.0  # in a strip of noise: as many false detections as a poor field has stars
KNOWN_RAD = np.full(3, 5e-6)
LIMIT_ARCSEC = {2: 0.07, 4: 0.05}  # rms of X and Y, the paper's cameras, by strips of the sky
RATES, STAGES = (0.8, 1.0, 1.2), (1, 16)
PER_DEG2 = 1200.0  # a star every 1000 pixels
FAINT_V, BRIGHT_V = (7.0, 9.5), (5.0, 7.2)
SNR = ((7.0, 15.0), (15.0, 60.0), (60.0, 1e4))
PHASES = 8  # of a pixel and of a row for which the bound is computed
STEPS = 8  # in which a row is divided


# ---- scans of rich fields ----


@cache
def rich_fields() -> Array:
    """Centres (FIELDS, 2), degrees, that hold most usable stars, none twice."""
    stars = all_hipparcos()
    places = stars.places
    use = stars.single & (places.v_mag > USABLE_V[0]) & (places.v_mag < USABLE_V[1])
    ra, dec = np.degrees(places.ra_rad[use]), np.degrees(places.dec_rad[use])
    rng = np.random.default_rng(0)
    found: list[tuple[float, float]] = []
    centres = np.column_stack([ra, dec])[np.abs(dec) < 70.0]
    centres = centres + rng.uniform(-0.3, 0.3, centres.shape)
    counts = np.array([np.count_nonzero(_inside(ra, dec, *centre)) for centre in centres[::4]])
    for k in np.argsort(-counts, kind="stable"):
        centre = centres[::4][k]
        if all(np.hypot(centre[0] - a, centre[1] - d) > 3.0 for a, d in found):
            found.append((float(centre[0]), float(centre[1])))
        if len(found) == FIELDS:
            break
    return np.array(found)


def _inside(ra: Array, dec: Array, ra0: float, dec0: float) -> NDArray[np.bool_]:
    east = (ra - ra0) * np.cos(np.radians(dec0))
    return (np.abs(east) < FIELD_DEG / 2) & (np.abs(dec - dec0) < FIELD_DEG / 2)


def planned(scenario: Scenario, scans: int, rng: np.random.Generator) -> tuple[SkyScan, ...]:
    """Scans of the richest fields in turn, each when both cameras see past the Earth."""
    fields = rich_fields()
    orbit = orbit_of(scenario)
    R_cs = installation_of_scenario(scenario.installation)
    chosen: list[SkyScan] = []
    for k in rng.permutation(len(fields)):
        angle = float(rng.choice([0.0, 90.0, 180.0, 270.0]))
        ra, dec = fields[k].tolist()
        for at_s in clear_times(orbit, R_cs, ra, dec, angle):
            if all(abs(at_s - one.at_s) > APART_S for one in chosen):
                chosen.append(SkyScan(ra, dec, at_s, angle))
                break
        if len(chosen) == scans:
            break
    return tuple(sorted(chosen, key=lambda one: one.at_s))


@cache
def orbit_of(scenario: Scenario) -> Orbit:
    """The orbit over one revolution."""
    earth = EarthRotation.over(Epoch.from_utc(scenario.epoch_utc), -10.0, 6000.0, bundled_earth_orientation())
    return flown_orbit(scenario.orbit, -5.0, 5900.0, earth)


def clear_times(orbit: Orbit, R_cs: Rotation, ra: float, dec: float, angle: float) -> list[float]:
    """Instants at which both cameras look past the Earth, the clearest first."""
    t_s = np.arange(120.0, 5600.0, 20.0)
    p_i, _ = orbit.states_i(t_s)
    up = p_i / np.linalg.norm(p_i, axis=1)[:, None]
    a, d, pa = np.radians([ra, dec, angle])
    z = np.array([np.cos(d) * np.cos(a), np.cos(d) * np.sin(a), np.sin(d)])
    north = np.array([-np.sin(d) * np.cos(a), -np.sin(d) * np.sin(a), np.cos(d)])
    x = np.cos(pa) * north + np.sin(pa) * np.cross(north, z)
    R_ci = Rotation.from_matrix(np.array([x, np.cross(z, x), z]))
    axis_s = (R_cs.inv() * R_ci).inv().apply([0.0, 0.0, 1.0])
    nearest = np.degrees(np.arccos(np.clip(np.maximum(-(up @ z), -(up @ axis_s)), -1.0, 1.0)))
    order = np.argsort(-nearest, kind="stable")
    return [float(t_s[k]) for k in order if nearest[k] > CLEAR_DEG]


def scenario_of(cameras: str, scans: int, ground: int, seed: int) -> Scenario:
    """A camera pair with scans of the sky, and strips of the ground beside them."""
    base = replace(
        builtin_scenario(cameras), star_camera=replace(builtin_scenario(cameras).star_camera, rate_hz=RATE_HZ)
    )
    planned_scans = planned(base, scans, np.random.default_rng(seed))
    sky = SkyStripSettings(scans=planned_scans, only_around_stars_px=60.0)
    if cameras == "mini":  # pixels and rows twelve times larger
        sky = replace(
            sky,
            lines=2000,
            row_period_s=5.4e-3,
            flux_v0_e_per_s=1e9,
            hot_columns=5,
            cosmic_rays=2,
            only_around_stars_px=0.0,
        )
    strips = replace(base.strips, count=ground, only_around_targets_px=400.0)
    return replace(base, sky_strips=sky if scans else SkyStripSettings(), strips=strips)


# ---- missions ----


@dataclass(frozen=True)
class Outcome:
    """One calibrated mission."""

    error: Array  # (3,) rad
    covariance: Array
    named: int
    wrong: int

    @property
    def nees(self) -> float:
        """Normalised error squared."""
        return float(self.error @ np.linalg.solve(self.covariance, self.error))

    @classmethod
    def of(cls, found: DumpCalibration, mission: Mission, R_true: Rotation) -> Outcome:
        """The calibration of a mission, held against its truth."""
        assert isinstance(found.estimate, InstallationEstimate)
        error = theta_between(found.estimate.R_cs, R_true)
        named = sum(len(one.rows) for one in found.named)
        return cls(error, found.estimate.cov_theta, named, wrong_names(found, mission))


def wrong_names(found: DumpCalibration, mission: Mission) -> int:
    """Names that are not those of the star that crosses there, to 5 px."""
    wrong = 0
    for one in found.named:
        seen = one.found.take(one.rows)
        for k, hip in enumerate(one.places.places.hip.tolist()):
            near = [
                star
                for star in mission.truth.sky_stars
                if (star.strip_id, star.ccd, star.hip) == (one.strip_id, seen.ccd[k], hip)
                and np.hypot(star.sample - seen.xy_px[k, 0], star.line - seen.xy_px[k, 1]) < 5.0
            ]
            wrong += not near
    return wrong


def missions(options: argparse.Namespace) -> None:
    """From simulation to the error of the matrix."""
    done: list[Outcome] = []
    for seed in range(1, options.seeds + 1):
        start = time.process_time()
        with tempfile.TemporaryDirectory() as scratch:
            mission = fly(scenario_of(options.cameras, options.scans, options.ground, seed), seed)
            write_dump(mission, Path(scratch) / "dump", created_by="benchmark")
            try:
                done.append(
                    Outcome.of(calibrate_dump(open_dump(Path(scratch) / "dump")), mission, mission.truth.R_cs)
                )
            except DataNotSufficientError as error:
                print(f"{seed:4d}  {error}", flush=True)
                continue
        one = done[-1]
        e, s = one.error / ARCSEC, np.sqrt(np.diag(one.covariance)) / ARCSEC
        print(
            f"{seed:4d}  error {e.round(3)}  sigma {s.round(3)}  NEES {one.nees:6.2f}  {one.named} stars, "
            f"{one.wrong} wrong  {time.process_time() - start:.0f} s CPU",
            flush=True,
        )
    name = f"{options.cameras}, {options.scans} strips of the sky, {options.ground} of the ground"
    judge_share(f"{name}: calibrated", len(done), options.seeds, least=1.0)
    judge_share(f"{name}: wrong names", sum(o.wrong for o in done), sum(o.named for o in done), most=0.0)
    judge_nees(name, [one.nees for one in done])
    rms = np.sqrt(np.mean([one.error**2 for one in done], axis=0)) / ARCSEC
    bound = np.sqrt(np.mean([np.diag(one.covariance) for one in done], axis=0)) / ARCSEC
    print(
        f"rms {rms.round(3)}, bound {bound.round(3)} arcsec; {np.mean([one.named for one in done]):.1f} stars"
    )
    if options.cameras == "paper" and options.scans in LIMIT_ARCSEC and not options.ground:
        judge_largest(
            f"{name}: rms of X and Y", rms[:2].max(), LIMIT_ARCSEC[options.scans], "arcsec", len(done)
        )


# ---- attitudes of a tracker ----


def trackers(options: argparse.Namespace) -> None:
    """Scans with attitudes in place of star images, for two heads."""
    heads = {"star camera of the paper": [], "head mounted at random": []}
    files = {"remote_camera": "remote_camera.toml", "orbit": "orbit.oem", "strips": "strips.csv"}
    for seed in range(1, options.seeds + 1):
        mission = fly(scenario_of("mini", scans=1, ground=0, seed=seed), seed)
        mounted = (Rotation.identity(), Rotation.random(rng=np.random.default_rng([seed, 3])))
        for kind, (words, R_sh) in enumerate(zip(heads, mounted)):
            with tempfile.TemporaryDirectory() as scratch:
                root = Path(scratch) / "dump"
                write_dump(replace(mission, exposures=()), root, created_by="benchmark")
                rng = np.random.default_rng([seed, 4, kind])
                write_heads(root, mission, (TrialHead("STR", R_sh, TRACKER),), rng, files)
                try:
                    found = calibrate_dump(open_dump(root))
                except DataNotSufficientError as error:
                    print(f"{seed:4d}  {words:26s}  refused: {error}", flush=True)
                    continue
            one = Outcome.of(found, mission, mission.truth.R_cs * R_sh)
            heads[words].append(one)
            print(
                f"{seed:4d}  {words:26s}  {one.named} named, {one.wrong} wrong  NEES {one.nees:5.2f}",
                flush=True,
            )
    for words, done in heads.items():
        judge_share(f"{words}, 1, 1, 8 arcsec: calibrated", len(done), options.seeds, least=0.9)
        if done:
            judge_nees(f"{words}, 1, 1, 8 arcsec", [one.nees for one in done])
    every = [one for done in heads.values() for one in done]
    judge_share(
        "tracker's attitudes: wrong names", sum(o.wrong for o in every), sum(o.named for o in every), most=0.0
    )


# ---- noise ----


@dataclass(frozen=True)
class InMemory:
    """Images of a strip that lie in memory."""

    images: dict[int, NDArray[np.uint8]]

    @property
    def ccds(self) -> tuple[int, ...]:
        return tuple(self.images)

    @property
    def shapes(self) -> dict[int, tuple[int, ...]]:
        return {ccd: image.shape for ccd, image in self.images.items()}

    def shape(self, ccd: int) -> tuple[int, ...]:
        return self.images[ccd].shape

    def read(self, ccd: int, line0: int, line1: int, sample0: int, sample1: int) -> NDArray[np.uint8]:
        return self.images[ccd][line0:line1, sample0:sample1]


def noise(options: argparse.Namespace) -> None:
    """Strips of noise, half of them with hot columns, in place of the fixture's: nothing may get a name."""
    strips = options.seeds
    dump = open_dump(ROOT / "fixtures" / "sky")
    settings = Settings(sky_strips=StripStarSettings(false_alarms_per_strip=NOISE_PEAKS))
    fit = calibration_settings(settings, dump.errors, dump.line_camera).attitudes
    reference = sight_head(dump, dump.heads[0], settings, fit, StageRunner())
    task = find_in_sky_strips(dump, [reference], settings, StageRunner()).tasks[0]
    survey, sigma = all_hipparcos(), dump.sigma_installation_rad
    detections, named, chance = 0, 0, 0.0
    for seed in range(strips):
        rng = np.random.default_rng(seed)
        images = {}
        for ccd, shape in task.strip.images.shapes.items():
            level = np.full(shape[1], 12.0)
            if seed % 2:
                level[rng.integers(0, shape[1], 20)] += rng.uniform(2.0, 60.0, 20)
            image = level + rng.standard_normal(shape) * np.sqrt(0.6**2 + (level - 12.0) / 60.0)
            images[ccd] = np.clip(np.rint(image), 0, 255).astype(np.uint8)
        of_noise = replace(task, strip=replace(task.strip, images=InMemory(images)))
        found = find_sky_stars(of_noise)
        if isinstance(found, Omission):
            continue
        detections += len(found.ccd)
        voted = name_sky_stars(of_noise, found, survey, dump.R_cs0, sigma, known=False, scatter_px=0.1)
        named += len(voted.rows) > 0
        # and with the mounting known: a peak beside a star's place may get its name
        near = name_sky_stars(of_noise, found, survey, dump.R_cs0, KNOWN_RAD, known=True, scatter_px=0.1)
        chance += len(near.rows)
    print(f"{strips} strips, half with 20 hot columns a CCD; {detections / strips:.1f} peaks")
    judge_share("strips of noise with names by the vote for the mounting", named, strips, most=0.0)
    print(f"{chance / strips:.4f} names a strip where the mounting is known beforehand")


# ---- places of stars ----


@dataclass(frozen=True)
class Seen:
    """Stars of many strips."""

    snr: Array  # (N,)
    error: Array  # (N, 2) px
    phase: Array  # (N, 2) of the true place, 0 to 1
    stated2: Array  # (N, 2) px2
    bound2: Array  # (N, 2) px2


def scenario_with(rate: float, stages: int, v_range: tuple[float, float], seed: int) -> Scenario:
    """Many stars, no vibration: jitter within a trace is an error of its own."""
    scenario = scenario_of("mini", 1, 0, seed)
    sky = replace(
        scenario.sky_strips,
        scans=(replace(scenario.sky_strips.scans[0], rate=rate),),
        uncatalogued_per_deg2=PER_DEG2,
        uncatalogued_v_range=v_range,
        flux_v0_e_per_s=scenario.sky_strips.flux_v0_e_per_s / stages,
    )
    return replace(
        scenario,
        errors=replace(scenario.errors, vibration_arcsec=0.0),
        attitude=replace(scenario.attitude, waves=()),
        sky_strips=sky,
        line_camera=replace(scenario.line_camera, tdi_stages=stages),
    )


def measured(rate: float, stages: int, v_range: tuple[float, float], seed: int) -> Seen:
    """The stars of one strip."""
    scenario = scenario_with(rate, stages, v_range, seed)
    mission = fly(scenario, seed)
    images = {strip.ccd: next(strip.blocks(strip.lines)) for strip in mission.strips}
    count = len(images)
    motion = StripMotion(np.array([0.0, 2e3]), np.full((count, 2), rate), np.zeros((count, 2)), stages)
    found = find_strip_stars(InMemory(images), motion, StripStarSettings(), 255.0)
    return compared(found.take(~found.blended & ~found.saturated), mission, rate, stages)


def compared(stars: StripStars, mission: Mission, rate: float, stages: int) -> Seen:
    """Detections beside the truth."""
    scenario, truth = mission.scenario, mission.truth.sky_stars
    true = np.array([(s.sample, s.line, 1e6 * s.ccd) for s in truth])
    charge = np.array([s.charge_e for s in truth]) / scenario.ground.e_per_dn
    tree = cKDTree(true)
    distance, row = tree.query(np.column_stack([stars.xy_px, 1e6 * stars.ccd]))
    lonely = tree.query(true, k=2)[0][:, 1] > 16.0 + abs(1.0 - rate) * stages
    size = np.array([(strip.samples, strip.lines) for strip in mission.strips])[stars.ccd]
    inside = (np.abs(true[row, :2] - 0.5 * (size - 1.0)) < 0.5 * size).all(axis=1)
    hit = np.flatnonzero((distance < 2.0) & lonely[row] & inside)
    place = true[row[hit], :2]
    return Seen(
        snr=stars.snr[hit],
        error=stars.xy_px[hit] - place,
        phase=(place + 0.5) % 1.0,
        stated2=np.diagonal(stars.cov_px[hit], axis1=1, axis2=2),
        bound2=bound(place, charge[row[hit]], rate, stages, scenario),
    )


def bound(place: Array, flux_dn: Array, rate: float, stages: int, scenario: Scenario) -> Array:
    """Variances (N, 2), px2, that no unbiased estimate of the places (N, 2) can be below."""
    detector, sky = scenario.ground, scenario.sky_strips
    noise2 = detector.read_noise_dn**2 + sky.background_dn / detector.e_per_dn + 1.0 / 12.0
    cell = (np.floor(((place + 0.5) % 1.0) * PHASES)).astype(int)
    variance = np.zeros((len(place), 2))
    for column, row in np.unique(cell, axis=0).tolist():
        here = np.flatnonzero((cell == (column, row)).all(axis=1))
        x, y = ((np.array([column, row]) + 0.5) / PHASES - 0.5).tolist()
        unit = [
            trace(x + dx, y + dy, rate, stages, sky.psf_sigma_px)
            for dx, dy in ((0, 0), (1e-3, 0), (-1e-3, 0), (0, 1e-3), (0, -1e-3))
        ]
        slopes = np.stack([(unit[1] - unit[2]) / 2e-3, (unit[3] - unit[4]) / 2e-3, unit[0]])
        flux = flux_dn[here, None]
        model = np.concatenate([slopes[None] * flux[..., None], np.ones((len(here), 1, unit[0].size))], 1)
        model[:, 2] = unit[0]
        weight = 1.0 / (noise2 + flux * unit[0] / detector.e_per_dn)
        fisher = np.einsum("nam,nm,nbm->nab", model, weight, model)
        variance[here] = np.diagonal(np.linalg.inv(fisher), axis1=1, axis2=2)[:, :2]
    return variance


def trace(x: float, y: float, rate: float, stages: int, sigma_px: float) -> Array:
    """Image (M,) of unit charge of a star that crosses at (x, y) from the middle of a window."""
    half = int(np.ceil(4.0 * sigma_px / min(rate, 1.0) + 2.0 + 0.5 * stages * abs(1.0 - rate) / rate))
    k = np.arange(-half, half + 1.0)[:, None, None]
    j = (np.arange(stages) - 0.5 * (stages - 1))[:, None]
    t = k + j + ((np.arange(STEPS) + 0.5) / STEPS - 0.5)
    along = rate * (t - y) - j
    share = (ndtr((along + 0.5) / sigma_px) - ndtr((along - 0.5) / sigma_px)).sum(axis=(1, 2))
    edges = np.arange(-half - 0.5, half + 1.0)
    return np.outer(share * rate / (stages * STEPS), np.diff(ndtr((edges - x) / sigma_px))).ravel()


def places_of_stars(options: argparse.Namespace) -> None:
    """A line for each rate, number of stages and range of SNR."""
    print("rate  TDI      SNR  stars  rms / bound  rms / stated  rms, px   (column, row)", flush=True)
    for stages in STAGES:
        for rate in RATES:
            kinds = [(FAINT_V, n) for n in range(options.seeds)]
            kinds += [(BRIGHT_V, n) for n in range((options.seeds + 1) // 2)]
            parts = [measured(rate, stages, v_range, seed) for v_range, seed in kinds]
            seen = Seen(*(np.concatenate([getattr(p, f) for p in parts]) for f in Seen.__annotations__))
            for limits in SNR:
                row_of_places(rate, stages, seen, limits)


def row_of_places(rate: float, stages: int, seen: Seen, limits: tuple[float, float]) -> None:
    """One line, and the verdict on both axes."""
    part = (seen.snr >= limits[0]) & (seen.snr < limits[1])
    n, squares = int(part.sum()), (seen.error[part] ** 2).sum(axis=0)
    to_bound = np.sqrt(squares / seen.bound2[part].sum(axis=0))
    to_stated = np.sqrt((seen.error[part] ** 2 / seen.stated2[part]).mean(axis=0))
    rms = np.sqrt(squares / n)
    print(
        f"{rate:4.1f} {stages:4d} {limits[0]:5.0f}-{limits[1]:<5.0f} {n:5d}  {to_bound.round(3)}  "
        f"{to_stated.round(3)}  {rms.round(4)}",
        flush=True,
    )
    if n >= 20:
        text = f"rate {rate:g}, {stages} stages, SNR from {limits[0]:g}: rms error of a place over bound"
        judge_largest(text, float(to_bound.max()), 1.1 + 3.3 / np.sqrt(2.0 * n), "", n)


WHAT = {
    "missions": (missions, 12),
    "trackers": (trackers, 8),
    "noise": (noise, 40),
    "places": (places_of_stars, 1),
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=WHAT)
    parser.add_argument("--seeds", type=int, help="missions, strips of noise, or strips of each row")
    parser.add_argument("--scans", type=int, default=2)
    parser.add_argument("--ground", type=int, default=0)
    parser.add_argument("--cameras", choices=("paper", "mini"), default="mini")
    options = parser.parse_args()
    work, seeds = WHAT[options.what]
    options.seeds = options.seeds or seeds
    head(f"Strips of the sky: {options.what}")
    work(options)
    return exit_status()


if __name__ == "__main__":
    sys.exit(main())
