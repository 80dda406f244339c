"""Strips of the sky with attitudes of a star tracker of 1, 1 and 8 arcsec: which dumps are calibrated, and
whether each star has its own name.

    python benchmarks/sky_attitudes.py --missions 20 > benchmarks/results/sky_attitudes.txt

Each mission is one scan of a field rich in stars by the small camera pair, from raw pixels. It is calibrated
twice: with the attitudes of a head that looks where the star camera of the paper looks, 15 degrees from the
line of sight backwards, and with those of a head mounted at random, whose 8 arcsec move stars by 3 pixels.
Attitudes are the truth with noise of the stated size.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from fault_dumps import TRACKER, TrialHead, write_heads
from record import band_of_mean_nees, exit_status, head, verdict
from scipy.spatial.transform import Rotation
from sky_strips import scenario_of, wrong_names

from boresight.calib.estimate import InstallationEstimate
from boresight.geometry.installation import theta_between
from boresight.pipeline.calibration.calibrate import calibrate_dump
from boresight.pipeline.errors import DataNotSufficientError
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.files.dump_writer import write_dump
from boresight.pipeline.files.scenario_file import fly
from boresight.simulator.mission_records import Mission

KINDS = ("star camera of the paper", "head mounted at random")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--missions", type=int, default=20)
    parser.add_argument("--first", type=int, default=1, help="seed of the first mission")
    options = parser.parse_args()
    head("strips of the sky with attitudes of 1, 1, 8 arcsec")
    print("seed  head                        found named wrong   NEES  verdict", flush=True)
    start, rows = time.process_time(), []
    for seed in range(options.first, options.first + options.missions):
        rows += mission_rows(seed)
    print(f"{time.process_time() - start:.0f} s CPU")
    judge(np.array(rows))
    raise SystemExit(exit_status())


def mission_rows(seed: int) -> list[tuple[int, float, float, float]]:
    """Kind of head, named stars, wrong names and NEES, NaN where the dump was refused, for both heads."""
    mission = fly(scenario_of("mini", scans=1, ground=0, seed=seed), seed)
    mounted = (Rotation.identity(), Rotation.random(rng=np.random.default_rng([seed, 3])))
    with tempfile.TemporaryDirectory() as scratch:
        images = Path(scratch) / "images"
        write_dump(replace(mission, exposures=()), images, created_by="benchmarks/sky_attitudes.py")
        return [calibrated(seed, kind, R_sh, mission, images) for kind, R_sh in enumerate(mounted)]


def calibrated(
    seed: int, kind: int, R_sh: Rotation, mission: Mission, images: Path
) -> tuple[int, float, float, float]:
    """The mission with the attitudes of one head, calibrated."""
    root = images.parent / f"head-{kind}"
    shutil.copytree(images, root)
    files = {"remote_camera": "remote_camera.toml", "orbit": "orbit.oem", "strips": "strips.csv"}
    tracker = TrialHead("STR", R_sh, TRACKER)
    write_heads(root, mission, (tracker,), np.random.default_rng([seed, 4, kind]), files)
    try:
        result = calibrate_dump(open_dump(root))
    except DataNotSufficientError as error:
        print(f"{seed:4d}  {KINDS[kind]:26s}  refused: {error}", flush=True)
        return kind, 0.0, 0.0, np.nan
    assert isinstance(result.estimate, InstallationEstimate)
    R_ch = mission.truth.R_cs * R_sh
    error = theta_between(result.estimate.R_cs, R_ch)
    nees = float(error @ np.linalg.solve(result.estimate.cov_theta, error))
    found, named = len(result.sky.found[0].ccd), len(result.named[0].rows)
    wrong = wrong_names(result, mission)
    words = result.verdict.outcome.value
    print(f"{seed:4d}  {KINDS[kind]:26s}  {found:5d} {named:5d} {wrong:5d}  {nees:5.2f}  {words}", flush=True)
    return kind, named, wrong, nees


def judge(rows: np.ndarray) -> None:
    """What is asked: nine of ten dumps, no wrong name, NEES in its band."""
    for kind, words in enumerate(KINDS):
        of = rows[rows[:, 0] == kind]
        done = of[np.isfinite(of[:, 3])]
        verdict(f"{words}: {len(done)} of {len(of)} calibrated (9 of 10 asked)", len(done) >= 0.9 * len(of))
        if not len(done):
            continue
        low, high = band_of_mean_nees(len(done))
        nees = float(done[:, 3].mean())
        verdict(f"{words}: NEES {nees:.2f} (99.9 % band {low:.2f} to {high:.2f})", low < nees < high)
    wrong, named = int(rows[:, 2].sum()), int(rows[:, 1].sum())
    verdict(f"{wrong} wrong names of {named}", wrong == 0)


if __name__ == "__main__":
    main()
