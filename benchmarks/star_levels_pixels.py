"""One mission as star images, as centroid lists and as attitudes, each from pixels to the matrix.

    python benchmarks/star_levels_pixels.py --seeds 40 > benchmarks/results/star_levels_pixels.txt

Each seed renders the scenario `mini` anew. Its images go through `calibrate`; what `boresight centroids`
finds in the same images goes through `calibrate` as centroid lists, and the attitudes that the first run
solved from them, with their covariances, as the CSV of a head. The ground side is matched anew each time.
Printed are the differences in sigmas of the first result, the loss against it, and the squared errors.
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
from scipy.stats import chi2

from boresight.calib.estimate import InstallationEstimate
from boresight.geometry.constants import ARCSEC
from boresight.geometry.installation import theta_between
from boresight.pipeline.files.dump import Dump, open_dump
from boresight.pipeline.files.dump_writer import write_dump
from boresight.pipeline.files.scenario_file import fly, named_scenario
from boresight.pipeline.files.text_tables import write_csv
from boresight.pipeline.report.centroid_report import score_images
from boresight.pipeline.settings import Settings
from boresight.pipeline.stages.calibrate import Calibration, calibrate_dump

LEVELS = ("images", "centroids", "attitudes")
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
    options = parser.parse_args()
    head(f"levels of the star side from pixels, scenario {options.scenario}")
    print("seed   largest difference, sigma           sigma against images, %")
    print("       centroids    attitudes             centroids    attitudes", flush=True)
    runs = [one_mission(seed, options.scenario) for seed in range(1, options.seeds + 1)]
    judge(runs)
    raise SystemExit(exit_status())


def one_mission(seed: int, scenario: str) -> dict[str, tuple[InstallationEstimate, np.ndarray]]:
    """For each level the estimate and its error, theta (3,) against the truth."""
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "images"
        mission = fly(named_scenario(scenario, []), seed)
        write_dump(mission, root, created_by="benchmark")
        dump = open_dump(root)
        found = {"images": calibrate_dump(dump, Settings())}
        centroids(dump)
        attitudes(dump, found["images"])
        for level, keys in (("centroids", OF_CENTROIDS), ("attitudes", OF_ATTITUDES)):
            state(root, HEAD.format(level=level) + keys)
            found[level] = calibrate_dump(open_dump(root), Settings())
            shutil.copy(root / "dump.before", root / "dump.toml")
        truth = mission.truth.R_cs
    of_images = found["images"].estimate
    apart = [np.max(np.abs(difference(found[one].estimate, of_images))) for one in LEVELS[1:]]
    wider = [np.max(loss(found[one].estimate, of_images)) for one in LEVELS[1:]]
    row = (
        "".join(f"{value:12.5f} " for value in apart)
        + "          "
        + "".join(f"{100 * v:12.4f} " for v in wider)
    )
    print(f"{seed:4d} {row}", flush=True)
    return {one: (found[one].estimate, theta_between(found[one].estimate.R_cs, truth)) for one in LEVELS}


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


def attitudes(dump: Dump, found: Calibration) -> None:
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


def judge(runs: list[dict[str, tuple[InstallationEstimate, np.ndarray]]]) -> None:
    """Print the verdicts over all seeds."""
    low, high = chi2(3 * len(runs)).ppf([0.0005, 0.9995]) / len(runs)
    for level in LEVELS:
        nees = np.mean(
            [error @ np.linalg.solve(one.cov_theta, error) for one, error in (r[level] for r in runs)]
        )
        verdict(f"{level}: NEES {nees:.2f} of 3 (band {low:.2f} to {high:.2f})", bool(low < nees < high))
    for level, most_apart, most_wider in (("centroids", 0.01, 1e-4), ("attitudes", np.inf, 0.1)):
        pairs = [(run[level][0], run["images"][0]) for run in runs]
        apart = max(float(np.max(np.abs(difference(*pair)))) for pair in pairs)
        wider = float(np.mean([np.max(loss(*pair)) for pair in pairs]))
        text = f"{level} against images: at most {apart:.4f} sigma apart"
        text += f", {most_apart:g} allowed" if np.isfinite(most_apart) else ""
        text += f"; sigma {100 * wider:+.4f} %, {100 * most_wider:g} % allowed"
        verdict(text, apart <= most_apart and wider <= most_wider)


if __name__ == "__main__":
    main()
