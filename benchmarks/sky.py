"""Strips of the sky from raw pixels: the matrix without any ground, with a tracker's attitudes, and names in
strips of noise.

    python benchmarks/sky.py missions [--seeds 12] [--cameras mini] [--scans 2] [--ground 0]
    python benchmarks/sky.py trackers [--seeds 8]
    python benchmarks/sky.py noise [--seeds 40]

`missions`: mounting off by the paper's equation (28), all errors of its Table 1 on. Each scan looks at one of
the fields richest in Hipparcos stars that both cameras see past the Earth. The paper's cameras take 3 minutes
of CPU a mission. `trackers`: one scan with attitudes of 1, 1 and 8 arcsec in place of star images, of a head
that looks where the paper's star camera looks, and of one mounted at random, whose 8 arcsec move stars by 3
pixels. `noise`: strips of noise, half of them with hot columns, and what is named in them.
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
from scipy.spatial.transform import Rotation

sys.path.extend(str(ROOT / place) for place in ("tests", "tests/pipeline/faults"))

from fault_dumps import TRACKER, TrialHead, write_heads

from boresight.calib.estimate import InstallationEstimate
from boresight.geometry.constants import ARCSEC
from boresight.geometry.earth_orientation import bundled_earth_orientation
from boresight.geometry.earth_rotation import EarthRotation
from boresight.geometry.epoch import Epoch
from boresight.geometry.installation import theta_between
from boresight.geometry.orbit import Orbit
from boresight.pipeline.calibration.calibrate import DumpCalibration, calibrate_dump
from boresight.pipeline.errors import DataNotSufficientError
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.files.dump_writer import write_dump
from boresight.pipeline.files.scenario_file import fly
from boresight.pipeline.run.cached import StageRunner
from boresight.pipeline.run.settings import Settings
from boresight.pipeline.stages.head import sight_head
from boresight.pipeline.stages.sky_side import find_in_sky_strips
from boresight.pipeline.stages.sky_strip import find_sky_stars, name_sky_stars
from boresight.records.ledger import Entry
from boresight.simulator.cameras import installation_of_scenario
from boresight.simulator.mission_records import Mission
from boresight.simulator.motion import flown_orbit
from boresight.simulator.scenario import Scenario, SkyScan, SkyStripSettings, builtin_scenario
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
    reference = sight_head(dump, dump.heads[0], settings, StageRunner())
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
        if isinstance(found, Entry):
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


WHAT = {"missions": (missions, 12), "trackers": (trackers, 8), "noise": (noise, 40)}


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
