"""Sound dumps for trials with faults, each of one kind and seed.

    ground    star images and strips of the ground: `simulate mini` (seed 1: `fixtures/mini`)
    sky       star images and one scan of the sky: `simulate sky` (seed 1: `fixtures/sky`)
    scans     star images and two scans of the same field, one forward and one back
    mixed     star images, two strips of the ground and the two scans
    points    attitudes of two heads and measured image points, no images at all
    twelve    the same with a camera of 12 CCDs and a campaign of 12 strips, s1 to s12
    coloured  the same as points, the attitudes' noise partly coloured and partly constant over a strip
    trackers  attitudes of one head with 1, 1, 8 arcsec, and the images of `scans`

Attitudes and points are the simulator's truth with noise of the stated size; nothing of them comes from the
calibration on trial. A dump is made once in a working folder.
"""

import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from drawn_heads import correlated_noise
from scipy.spatial.transform import Rotation

from boresight.geometry.constants import ARCSEC
from boresight.pipeline.files.dump_writer import write_dump
from boresight.pipeline.files.scenario_file import fly
from boresight.pipeline.files.text_tables import write_csv, write_toml
from boresight.simulator.mission_records import Mission, TruePoint
from boresight.simulator.scenario import Scenario, SkyScan, builtin_scenario

__all__ = ["DUMPS", "TRACKER", "TrialHead", "flown", "linked", "sound_dump", "without_images", "write_heads"]

FIXTURES = Path(__file__).parents[3] / "fixtures"
DUMPS = ("ground", "sky", "scans", "mixed", "points", "twelve", "coloured", "trackers")
OF_FIXTURE = {("ground", 1): "mini", ("sky", 1): "sky"}
APART_S = 30.0  # from the scan to its repetition in the other direction
POINT_PX = 0.1  # 1-sigma of a measured image point
SURVEY_M = (0.3, 0.3, 0.5)  # ... of its coordinates: east, north, up
SECOND_HEAD = Rotation.from_euler("xyz", [-35.0, 20.0, 110.0], degrees=True)  # h to s: lopsided


@dataclass(frozen=True, slots=True)
class _Noise:
    """1-sigma about x, y, z of a head, arcsec; `correlation_s` of the coloured part."""

    white: tuple[float, float, float]
    coloured: tuple[float, float, float] = (0.0, 0.0, 0.0)
    constant: tuple[float, float, float] = (0.0, 0.0, 0.0)
    correlation_s: float = 0.8


@dataclass(frozen=True, slots=True)
class TrialHead:
    """A star camera that gives attitudes."""

    name: str
    R_sh: Rotation
    noise: _Noise


WHITE = _Noise((0.5, 0.5, 4.0))
COLOURED = _Noise((0.8, 0.9, 6.5), (0.5, 0.5, 4.7), (0.3, 0.3, 2.3))  # the example of docs/dump-format.md
TRACKER = _Noise((1.0, 1.0, 8.0))


@lru_cache(maxsize=3)
def flown(scenario: Scenario, seed: int) -> Mission:
    """The mission of a scenario: several dumps of a process are written from one."""
    return fly(scenario, seed)


def sound_dump(name: str, seed: int, work: Path) -> Path:
    """The folder of a dump without a fault; it is made where it is not there yet."""
    if fixture := OF_FIXTURE.get((name, seed)):
        return FIXTURES / fixture
    root = work / f"{name}-{seed}"
    if (root / "dump.toml").is_file():
        return root
    shutil.rmtree(root, ignore_errors=True)
    if name in ("points", "twelve", "coloured"):
        _points(root, seed, name, COLOURED if name == "coloured" else WHITE)
    elif name == "trackers":
        _trackers(root, seed, sound_dump("scans", seed, work))
    else:
        write_dump(flown(scenario_of(name), seed), root, created_by="fault_dumps.py")
    return root


def scenario_of(name: str) -> Scenario:
    """The scenario of a dump of images."""
    if name in ("ground", "points", "coloured"):
        return builtin_scenario("mini")
    if name == "twelve":
        mini = builtin_scenario("mini")
        urad = tuple(37.0 * (ccd - 4) for ccd in range(12))
        return replace(
            mini,
            line_camera=replace(
                mini.line_camera, ccds=12, samples=192, principal_sample=95.0, rotation_urad=urad
            ),
            strips=replace(mini.strips, count=12, lines=800),
            # points without the chip that a target has; no relief is matched
            targets=replace(mini.targets, per_strip=0, check_points_per_strip=16),
            terrain=replace(mini.terrain, spacing_arcsec=15.0),
        )
    sky = builtin_scenario("sky")
    if name == "sky":
        return sky
    (scan,) = sky.sky_strips.scans
    scans = (scan, SkyScan(scan.ra_deg, scan.dec_deg, scan.at_s + APART_S, rate=-1.0))
    count = 2 if name == "mixed" else 0
    return replace(
        sky,
        name=name,
        sky_strips=replace(sky.sky_strips, scans=scans),
        strips=replace(sky.strips, count=count),
    )


def linked(source: Path, target: Path) -> None:
    """A copy of hard links, without `truth/`: a file must be unlinked before it is written."""
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(source, target, copy_function=os.link, ignore=shutil.ignore_patterns("truth"))


def _points(root: Path, seed: int, name: str, noise: _Noise) -> None:
    """Two heads' attitudes and the image points of targets and check points."""
    mission, rng = flown(scenario_of(name), seed), np.random.default_rng([seed, 1])
    if name == "twelve":
        mission = with_short_ids(mission)
    write_dump(without_images(mission), root, created_by="fault_dumps.py")
    heads = (TrialHead("STR1", Rotation.identity(), noise), TrialHead("STR2", SECOND_HEAD, noise))
    files = {"remote_camera": "remote_camera.toml", "orbit": "orbit.oem", "strips": "strips.csv"}
    files |= {"points": "points.csv", "terrain": "terrain/dem.tif"}
    write_heads(root, mission, heads, rng, files)
    every = [*mission.truth.targets, *mission.truth.check_points]
    columns = ["id", "strip", "ccd", "sample", "line", "sigma_sample_px", "sigma_line_px", "lat_deg"]
    columns += ["lon_deg", "height_m", "height_kind", "sigma_east_m", "sigma_north_m", "sigma_up_m"]
    write_csv(root / "points.csv", columns, _measured(every, mission, rng))
    strips = [
        [s.strip_id, s.ccd, "", utc, repr(s.row_period_s), s.lines]
        for s, utc in zip(
            mission.strips, mission.epoch.utc_from_seconds([s.t_first_row_s for s in mission.strips])
        )
    ]
    write_csv(root / "strips.csv", ["id", "ccd", "file", "utc_first_row", "row_period_s", "lines"], strips)
    for name in ("exposures.csv", "star_camera.toml", "targets.csv"):
        (root / name).unlink()
    for name in ("exposures", "strips", "chips"):
        shutil.rmtree(root / name)


def with_short_ids(mission: Mission) -> Mission:
    """A mission whose ids of strips have no zeros before their numbers: s1 is the beginning of s12."""

    def renamed(record: Any) -> Any:
        return replace(record, strip_id=f"s{int(record.strip_id[1:])}")

    truth = replace(
        mission.truth,
        targets=tuple(map(renamed, mission.truth.targets)),
        check_points=tuple(map(renamed, mission.truth.check_points)),
    )
    return replace(mission, strips=tuple(map(renamed, mission.strips)), truth=truth)


def without_images(mission: Mission) -> Mission:
    """A mission of which only the tables are written."""
    return replace(mission, exposures=(), strips=(), chips=(), targets=())


def _measured(points: list[TruePoint], mission: Mission, rng: np.random.Generator) -> Iterator[list[object]]:
    """Rows of points.csv: one survey error for each point, one of the image for each measurement."""
    metres_per_deg = np.radians(1.0) * 6.37e6
    for point_id in dict.fromkeys(point.point_id for point in points):
        east, north, up = rng.normal(0.0, SURVEY_M)
        for p in (p for p in points if p.point_id == point_id):
            sample, line = np.array([p.sample, p.line]) + rng.normal(0.0, POINT_PX, 2)
            lat = p.lat_deg + north / metres_per_deg
            lon = p.lon_deg + east / metres_per_deg / np.cos(np.radians(lat))
            yield [
                *(p.point_id, p.strip_id, p.ccd, f"{sample:.5f}", f"{line:.5f}", POINT_PX, POINT_PX),
                *(f"{lat:.10f}", f"{lon:.10f}", f"{p.height_ellipsoidal_m + up:.4f}", "ellipsoidal"),
                *SURVEY_M,
            ]


def _trackers(root: Path, seed: int, scans: Path) -> None:
    """The scans with the attitudes of one head instead of star images."""
    shutil.copytree(scans, root)
    mission, rng = flown(scenario_of("scans"), seed), np.random.default_rng([seed, 2])
    files = {"remote_camera": "remote_camera.toml", "orbit": "orbit.oem", "strips": "strips.csv"}
    write_heads(root, mission, (TrialHead("STR1", Rotation.identity(), TRACKER),), rng, files)
    shutil.rmtree(root / "exposures")
    (root / "exposures.csv").unlink()
    (root / "star_camera.toml").unlink()


def write_heads(
    root: Path,
    mission: Mission,
    heads: tuple[TrialHead, ...],
    rng: np.random.Generator,
    files: dict[str, str],
) -> None:
    """Attitudes of the heads at the instants of the exposures, and a dump.toml that states them."""
    R_cs0, sigma = mission.installation.R_cs, np.asarray(mission.installation.sigma_rad).tolist()
    true = [mission.truth.exposure(one.exposure_id) for one in mission.exposures]
    utc = mission.epoch.utc_from_seconds([one.t_s for one in true])
    tables = []
    for head in heads:
        of_head = {"quaternion_cs": (R_cs0 * head.R_sh).as_quat().tolist(), "sigma_rad": sigma}
        (root / f"installation_{head.name}.toml").unlink(missing_ok=True)
        write_toml(root / f"installation_{head.name}.toml", of_head)
        errors = Rotation.from_rotvec(drawn(head.noise, np.array([one.t_s for one in true]), rng))
        R_ih = [(head.R_sh.inv() * one.R_si).inv() for one in true]
        q = (Rotation.concatenate(R_ih) * errors.inv()).as_quat()
        rows = [[at, *(f"{value:.15f}" for value in row)] for at, row in zip(utc, q)]
        write_csv(root / f"{head.name}.csv", ["utc", "qx", "qy", "qz", "qw"], rows)
        tables.append(table_of(head))
    text = (root / "dump.toml").read_text()
    begin, end = text.index("[files]"), text.index("[errors]")
    named = "".join(f'{key} = "{value}"\n' for key, value in files.items())
    (root / "dump.toml").write_text(f"{text[:begin]}[files]\n{named}\n{text[end:]}" + "".join(tables))
    (root / "installation.toml").unlink()


def drawn(noise: _Noise, t_s: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Rotation vectors (K, 3), rad: white, autoregressive, and constant over each strip."""
    of_strip = np.concatenate([[0], np.cumsum(np.diff(t_s) > 5.0)])
    sigma = {name: np.array(getattr(noise, name)) * ARCSEC for name in ("white", "coloured", "constant")}
    error = sigma["white"] * rng.standard_normal((len(t_s), 3))
    error += (sigma["constant"] * rng.standard_normal((of_strip[-1] + 1, 3)))[of_strip]
    for n in range(of_strip[-1] + 1):
        rows = np.flatnonzero(of_strip == n)
        error[rows] += correlated_noise(sigma["coloured"], np.full(3, noise.correlation_s), t_s[rows], rng)
    return error


def table_of(head: TrialHead) -> str:
    """The head in dump.toml."""
    text = HEAD.format(name=head.name, white=list(head.noise.white))
    if any(head.noise.coloured):
        text += f"correlated_arcsec = {list(head.noise.coloured)}\n"
        text += f"correlation_time_s = {[head.noise.correlation_s] * 3}\n"
    if any(head.noise.constant):
        text += f"constant_arcsec = {list(head.noise.constant)}\n"
    return text


HEAD = """
[[star_cameras]]
name = "{name}"
level = "attitudes"
installation = "installation_{name}.toml"
attitudes = "{name}.csv"
frame = "GCRF"
rotation = "head to inertial"
aberration_removed = "annual and orbital"

[star_cameras.noise]
white_arcsec = {white}
"""
