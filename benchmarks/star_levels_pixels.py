"""One mission as star images, as centroid lists and as attitudes, each from pixels to the matrix.

    python benchmarks/star_levels_pixels.py --seeds 40 > benchmarks/results/star_levels_pixels.txt

Each seed renders the scenario `mini` anew. Its images go through `calibrate`; what `boresight centroids`
finds in the same images goes through `calibrate` as centroid lists, and the attitudes that the first run
solved from them, with their covariances, as the CSV of a head. The ground side is matched anew each time.
Printed are the differences in sigmas of the first result, and the loss against it. A run that was stopped
goes on with --resume.
"""

from __future__ import annotations

import argparse
import contextlib
import re
import shutil
import tempfile
from pathlib import Path

import numpy as np
from record import exit_status, head, verdict
from scipy.spatial.transform import Rotation

from boresight.calib.estimate import InstallationEstimate
from boresight.features.sky_images.centroid_report import score_images
from boresight.geometry.constants import ARCSEC
from boresight.geometry.installation import theta_between
from boresight.pipeline.calibration.calibrate import DumpCalibration, calibrate_dump
from boresight.pipeline.files.dump import Dump, open_dump
from boresight.pipeline.files.dump_writer import write_dump
from boresight.pipeline.files.scenario_file import fly, named_scenario
from boresight.pipeline.files.text_tables import write_csv
from boresight.pipeline.run.settings import Settings

HEAD = """
[[star_cameras]]
name = "HEAD"
level = "{level}"
installation = "installation.toml"
"""
OF_CENTROIDS = 'camera = "star_camera.toml"\nexposures = "exposures.csv"\ncentroids = "centroids.csv"\n'
OF_ATTITUDES = 'attitudes = "attitudes.csv"\nframe = "GCRF"\nrotation = "head to inertial"\n'
OF_ATTITUDES += 'aberration_removed = "annual and orbital"\n'
COVARIANCE = ("xx", "xy", "xz", "yy", "yz", "zz")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=40)
    parser.add_argument("--scenario", default="mini")
    parser.add_argument("--resume", type=Path, help="output of a run that was stopped: its seeds are taken")
    options = parser.parse_args()
    known = read_rows(options.resume) if options.resume else {}
    head(f"levels of the star side from pixels, scenario {options.scenario}")
    print("seed   largest difference, sigma           sigma against images, %")
    print("       centroids    attitudes             centroids    attitudes", flush=True)
    rows = []
    for seed in range(1, options.seeds + 1):
        rows.append(known.get(seed) or one_mission(seed, options.scenario))
        apart, wider = rows[-1][:2], rows[-1][2:]
        text = "".join(f"{value:12.5f} " for value in apart) + " " * 10
        print(f"{seed:4d} {text}" + "".join(f"{value:12.4f} " for value in wider), flush=True)
    judge(np.array(rows))
    raise SystemExit(exit_status())


def read_rows(path: Path) -> dict[int, list[float]]:
    """Rows of an output by their seeds."""
    rows = (line.split() for line in path.read_text().splitlines())
    return {int(row[0]): list(map(float, row[1:])) for row in rows if len(row) == 5 and row[0].isdigit()}


def one_mission(seed: int, scenario: str) -> list[float]:
    """Largest difference from the result of images, sigmas, of centroids and of attitudes; largest increase
    of sigma, per cent, of both.
    """
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "images"
        write_dump(fly(named_scenario(scenario, []), seed), root, created_by="benchmark")
        dump = open_dump(root)
        of_images = calibrate_dump(dump, Settings())
        centroids(dump)
        attitudes(dump, of_images)
        found = []
        for level, keys in (("centroids", OF_CENTROIDS), ("attitudes", OF_ATTITUDES)):
            state(root, HEAD.format(level=level) + keys)
            found.append(calibrate_dump(open_dump(root), Settings()).estimate)
            shutil.copy(root / "dump.before", root / "dump.toml")
    apart = [float(np.max(np.abs(difference(one, of_images.estimate)))) for one in found]
    return apart + [100.0 * float(np.max(loss(one, of_images.estimate))) for one in found]


def difference(found: InstallationEstimate, of_images: InstallationEstimate) -> np.ndarray:
    """(3,) in sigmas."""
    return theta_between(found.R_cs, of_images.R_cs) / of_images.sigma_theta


def loss(found: InstallationEstimate, of_images: InstallationEstimate) -> np.ndarray:
    """(3,) by which sigmas are larger."""
    return found.sigma_theta / of_images.sigma_theta - 1.0


def centroids(dump: Dump) -> None:
    """centroids.csv of all exposures, as the command `centroids` writes it in the folder of the dump."""
    with contextlib.chdir(dump.root):
        images = sorted(Path("exposures").iterdir())
        score_images(
            images,
            None,
            Settings().stars,
            psf_sigma_px=None,
            gain=None,
            dark=None,
            out=Path("centroids.csv"),
            plot=None,
            say=lambda text: None,
        )


def attitudes(dump: Dump, found: DumpCalibration) -> None:
    """attitudes.csv of the exposures with their full covariances."""
    solved, usable = found.attitudes, found.attitudes.usable
    t_s = np.array([one.t_s for one in found.stars])[usable]
    quaternions = Rotation.from_matrix(solved.R_si[usable]).inv().as_quat()
    parts = solved.covariance_s[usable][:, *np.triu_indices(3)] / ARCSEC**2
    columns = ["utc", "qx", "qy", "qz", "qw", *(f"cov_{axes}_arcsec2" for axes in COVARIANCE)]
    rows = (
        [t, *map(float, q), *map(float, c)]
        for t, q, c in zip(dump.epoch.utc_from_seconds(t_s), quaternions, parts)
    )
    write_csv(dump.root / "attitudes.csv", columns, rows)


def state(root: Path, of_head: str) -> None:
    """Have dump.toml state the star side by a head; the file before is kept as dump.before."""
    shutil.copy(root / "dump.toml", root / "dump.before")
    text = (root / "dump.toml").read_text()
    text = re.sub(r"(?m)^(star_camera|installation|exposures) = .*\n", "", text)
    (root / "dump.toml").write_text(text + of_head)


def judge(rows: np.ndarray) -> None:
    """Print the verdicts over all seeds."""
    centroids_apart, attitudes_apart = rows[:, 0].max(), rows[:, 1].max()
    text = f"{len(rows)} missions, centroids against images: at most {centroids_apart:.5f} sigma apart"
    verdict(f"{text}, 0.01 allowed", bool(centroids_apart <= 0.01))
    wider = rows[:, 3].mean()
    text = f"{len(rows)} missions, attitudes against images: sigma {wider:+.4f} %, 10 % allowed; at most "
    verdict(f"{text}{attitudes_apart:.5f} sigma apart", bool(wider <= 10.0))


if __name__ == "__main__":
    main()
