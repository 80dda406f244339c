"""Strips of the sky: how good the matrix is without any ground, and beside it; stars in strips of noise.

    python benchmarks/sky_strips.py missions --seeds 1-40 --scans 2 [--ground 0]
    python benchmarks/sky_strips.py noise

`missions`: the paper's cameras, mounting off by the paper's equation (28), all errors of its Table 1 on, from
raw pixels (strips rendered around stars only). Each scan looks at one of the fields richest in Hipparcos
stars that both cameras see past the Earth. `noise`: strips of noise and of hot columns, and what is named in
them.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
import time
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from record import band_of_mean_nees, commit, exit_status, head, verdict
from scipy.spatial.transform import Rotation

from boresight.calib.estimate import InstallationEstimate
from boresight.geometry.constants import ARCSEC
from boresight.geometry.earth_orientation import bundled_earth_orientation
from boresight.geometry.earth_rotation import EarthRotation
from boresight.geometry.epoch import Epoch
from boresight.geometry.installation import theta_between
from boresight.geometry.ledger import Entry
from boresight.geometry.orbit import Orbit
from boresight.pipeline.calibration.calibrate import DumpCalibration, calibrate_dump
from boresight.pipeline.errors import DataNotSufficientError
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


@dataclass(frozen=True)
class Outcome:
    """One mission."""

    seed: int
    error: Array  # (3,) rad
    covariance: Array
    stars: int
    wrong: int
    cpu_s: float


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


def run(cameras: str, seed: int, scans: int, ground: int, scratch: Path) -> Outcome:
    """One mission, from its simulation to the error of its matrix."""
    folder = scratch / f"dump-{seed}"
    start = time.process_time()
    try:
        mission = fly(scenario_of(cameras, scans, ground, seed), seed)
        write_dump(mission, folder, created_by="benchmarks/sky_strips.py")
        found = calibrate_dump(open_dump(folder))
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    assert isinstance(found.estimate, InstallationEstimate)
    return Outcome(
        seed,
        theta_between(found.estimate.R_cs, mission.truth.R_cs),
        found.estimate.cov_theta,
        sum(len(one.rows) for one in found.named),
        wrong_names(found, mission),
        time.process_time() - start,
    )


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
    print(f"{options.cameras} cameras: {options.scans} strips of the sky, {options.ground} of the ground")
    print("seed      X        Y        Z   sigma X      Y       Z      NEES  stars wrong   s CPU", flush=True)
    done = kept(options)
    lost = 0
    for one in done.values():
        print(line_of(one), flush=True)
    with tempfile.TemporaryDirectory(dir=options.scratch) as scratch:
        for seed in (seed for seed in options.seeds if seed not in done):
            try:
                one = run(options.cameras, seed, options.scans, options.ground, Path(scratch))
            except DataNotSufficientError as error:
                lost += 1
                print(f"{seed:4d}  {error}", flush=True)
                continue
            done[seed] = one
            print(line_of(one), flush=True)
            if options.keep:
                with options.keep.open("a") as file:
                    file.write(json.dumps(asdict(one) | key_of(options), default=np.ndarray.tolist) + "\n")
    summary(list(done.values()), lost, options)


def key_of(options: argparse.Namespace) -> dict[str, object]:
    """What missions of one table share."""
    return {"commit": commit(), **{name: getattr(options, name) for name in ("cameras", "scans", "ground")}}


def kept(options: argparse.Namespace) -> dict[int, Outcome]:
    """Missions of the same table and commit that an earlier call has done, by seed."""
    if not options.keep or not options.keep.exists():
        return {}
    key, found = key_of(options), {}
    for row in map(json.loads, options.keep.read_text().splitlines()):
        if {name: row.pop(name) for name in key} == key and row["seed"] in options.seeds:
            of = {name: np.array(row.pop(name)) for name in ("error", "covariance")}
            found[row["seed"]] = Outcome(**row, **of)
    return found


def line_of(one: Outcome) -> str:
    """A row of the table."""
    e, s = one.error / ARCSEC, np.sqrt(np.diag(one.covariance)) / ARCSEC
    nees = one.error @ np.linalg.solve(one.covariance, one.error)
    return (
        f"{one.seed:4d} {e[0]:+8.3f} {e[1]:+8.3f} {e[2]:+8.2f}   {s[0]:6.3f}  {s[1]:6.3f}  {s[2]:6.2f}  "
        f"{nees:6.2f}  {one.stars:5d} {one.wrong:5d}  {one.cpu_s:6.0f}"
    )


def summary(done: list[Outcome], lost: int, options: argparse.Namespace) -> None:
    errors, covariances = np.array([o.error for o in done]), np.array([o.covariance for o in done])
    nees = float(np.mean(np.einsum("ra,rab,rb->r", errors, np.linalg.inv(covariances), errors)))
    rms = np.sqrt(np.mean(errors**2, axis=0)) / ARCSEC
    bound = np.sqrt(np.mean(np.diagonal(covariances, axis1=1, axis2=2), axis=0)) / ARCSEC
    print(
        f"\nrms {rms.round(3)}, bound {bound.round(3)} arcsec; {np.mean([o.stars for o in done]):.1f} stars"
    )
    verdict(f"found in {len(done)} of {len(done) + lost}", lost == 0)
    wrong = sum(o.wrong for o in done)
    verdict(f"{wrong} wrong names of {sum(o.stars for o in done)}", wrong == 0)
    low, high = band_of_mean_nees(len(done))
    verdict(f"NEES {nees:.2f} (2.3 to 3.8; 99.9 % band {low:.2f} to {high:.2f})", 2.3 < nees < 3.8)
    ratio = _xy(errors, covariances)
    verdict(f"rms / bound {(rms / bound).round(2)}, X and Y together {ratio:.2f} (at most 1.1)", ratio <= 1.1)
    if options.cameras == "paper" and options.scans and not options.ground:
        limit = {2: 0.07, 4: 0.05}.get(options.scans, np.inf)
        verdict(f"X and Y {rms[:2].round(3)} arcsec rms (at most {limit})", bool((rms[:2] <= limit).all()))


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
    dump = open_dump(Path(__file__).parents[1] / "fixtures" / "sky")
    settings = Settings(sky_strips=StripStarSettings(false_alarms_per_strip=NOISE_PEAKS))
    fit = calibration_settings(settings, dump.errors, dump.line_camera).attitudes
    reference = sight_head(dump, dump.heads[0], settings, fit, StageRunner())
    task = find_in_sky_strips(dump, [reference], settings, StageRunner()).tasks[0]
    survey, sigma = all_hipparcos(), dump.sigma_installation_rad
    detections, named, chance = 0, 0, 0.0
    for seed in range(options.strips):
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
        named += len(voted.rows)
        # and with the mounting known: a peak beside a star's place may get its name
        near = name_sky_stars(of_noise, found, survey, dump.R_cs0, KNOWN_RAD, known=True, scatter_px=0.1)
        chance += len(near.rows)
    print(f"{options.strips} strips, half with 20 hot columns a CCD; {detections / options.strips:.1f} peaks")
    verdict(f"{named} names by the vote for the mounting", named == 0)
    print(f"{chance / options.strips:.4f} names a strip where the mounting is known beforehand")


def _xy(errors: Array, covariances: Array) -> float:
    return float(
        np.sqrt((errors[:, :2] ** 2).sum() / np.diagonal(covariances, axis1=1, axis2=2)[:, :2].sum())
    )


def seeds(text: str) -> list[int]:
    first, _, last = text.partition("-")
    return list(range(int(first), int(last or first) + 1))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("missions", "noise"))
    parser.add_argument("--seeds", type=seeds, default=seeds("1-40"))
    parser.add_argument("--scans", type=int, default=2)
    parser.add_argument("--ground", type=int, default=0)
    parser.add_argument("--cameras", choices=("paper", "mini"), default="paper")
    parser.add_argument("--strips", type=int, default=200)
    parser.add_argument("--scratch", type=Path)
    parser.add_argument("--keep", type=Path, help="file of missions done; those of this commit count")
    options = parser.parse_args()
    head(f"strips of the sky: {options.what}")
    {"missions": missions, "noise": noise}[options.what](options)


if __name__ == "__main__":
    main()
    raise SystemExit(exit_status())
