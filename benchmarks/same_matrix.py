"""Where the matrix of a dump differs from that of an older checkout: places of targets, choice, estimation.

    python benchmarks/same_matrix.py DUMP --old CHECKOUT

Both calibrate the dump. Then the present estimator is given the older places of the targets that both
matched, which tells what a faster matching moves from what a better acceptance or estimator does. Places of
targets that the present code alone has matched are compared with the truth of a simulated dump.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
from numpy.typing import NDArray
from record import commit, exit_status, head, program, verdict

from boresight.calib.calibration import calibrate_strips
from boresight.calib.estimate import InstallationEstimate
from boresight.geometry.sightings import GroundSightings, StripSightings
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.stages.calibrate import calibrate_dump

ALLOWED = 0.01  # of the stated standard errors: what a faster matching may move


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("dump", type=Path)
    parser.add_argument("--old", type=Path, required=True, help="an older checkout")
    options = parser.parse_args()
    dump = open_dump(options.dump)
    present = calibrate_dump(dump)
    with tempfile.TemporaryDirectory() as folder:
        theta_old, rows = older_result(options.old.resolve(), options.dump.resolve(), Path(folder, "result"))
    both = [(common(strip, rows), older_places(strip, rows)) for strip in present.strips]
    now, then = zip(*both)
    sigma = present.estimate.sigma_theta
    theta_now, theta_then = (theta_of(strips, dump.R_cs0, present.settings) for strips in (now, then))
    head("Where the matrix differs from that of an older checkout, in standard errors of X, Y, Z")
    print(f"older checkout: {commit(options.old)}; dump: {options.dump.name}, {dump.mission}")
    for strip, one, old in zip(present.strips, now, then):
        more = sorted(set(strip.ground.target_id.tolist()) - set(one.ground.target_id.tolist()))
        moved = np.abs(one.ground.xy_px - old.ground.xy_px)
        print(
            f"{strip.strip_id}: {len(moved)} targets matched by both, places differ by "
            f"{np.sqrt(np.mean(moved**2)):.4f} px rms; by the present code alone: {', '.join(more) or 'none'}"
        )
        for target, error in errors_px(options.dump, strip, set(more)).items():
            print(f"     {target}: {error:.2f} px from its true place, vibration included")
    parts = {
        "places of the same targets": theta_now - theta_then,
        "targets that only one has matched": present.estimate.theta - theta_now,
        "stars and estimation": theta_then - theta_old,
        "all": present.estimate.theta - theta_old,
    }
    for name, moved in parts.items():
        print(f"{name:36s}" + "".join(f"{value:10.4f}" for value in moved / sigma))
    most = float(np.max(np.abs(parts["places of the same targets"] / sigma)))
    verdict(f"the same targets give the older matrix to {ALLOWED} sigma: {most:.4f}", most <= ALLOWED)
    sys.exit(exit_status())


def older_result(
    checkout: Path, dump: Path, result: Path
) -> tuple[NDArray[np.float64], dict[tuple[str, str, int], dict[str, Any]]]:
    """theta (3,) rad that the older checkout finds, and its rows of targets by strip, target and CCD."""
    arguments = ["calibrate", str(dump), "--out", str(result), "--no-report"]
    command = [sys.executable, "-c", program(checkout), *arguments]
    environment = os.environ | {"PYTHONPATH": str(checkout)}
    subprocess.run(command, cwd=checkout, env=environment, check=True, capture_output=True)
    theta = np.array(json.loads((result / "installation.json").read_text())["theta_rad"])
    rows = pq.read_table(result / "sightings" / "targets.parquet").to_pylist()
    return theta, {(row["strip_id"], row["target_id"], row["ccd"]): row for row in rows}


def errors_px(dump: Path, strip: StripSightings, targets: set[str]) -> dict[str, float]:
    """Distances of matched targets from their true places, of the dump's truth; empty without one."""
    if not (table := dump / "truth" / "targets.csv").is_file():
        return {}
    truth = pd.read_csv(table).set_index(["strip", "id", "ccd"])[["sample", "line"]]
    ground = strip.ground
    rows = zip(ground.target_id.tolist(), ground.ccd.tolist(), ground.xy_px)
    return {
        f"{target} in CCD {ccd}": float(np.hypot(*(xy - truth.loc[strip.strip_id, target, ccd].to_numpy())))
        for target, ccd, xy in rows
        if target in targets
    }


def common(strip: StripSightings, rows: dict[tuple[str, str, int], dict[str, Any]]) -> StripSightings:
    """The strip with those of its targets that the older checkout matched, too."""
    ground = strip.ground
    keys = zip(ground.target_id.tolist(), ground.ccd.tolist())
    known = np.array([(strip.strip_id, *key) in rows for key in keys], dtype=bool)
    kept = {field.name: getattr(ground, field.name)[known] for field in fields(GroundSightings)}
    return replace(strip, ground=GroundSightings(**kept), R_oi_targets=strip.R_oi_targets[known])


def older_places(strip: StripSightings, rows: dict[tuple[str, str, int], dict[str, Any]]) -> StripSightings:
    """`common` as the older checkout measured it."""
    both = common(strip, rows)
    ground = both.ground
    old = [rows[strip.strip_id, *key] for key in zip(ground.target_id.tolist(), ground.ccd.tolist())]
    columns = {
        field.name: np.array([row[field.name] for row in old]).reshape(getattr(ground, field.name).shape)
        for field in fields(GroundSightings)
    }
    return replace(both, ground=GroundSightings(**columns))


def theta_of(strips: Sequence[StripSightings], R_cs0: Any, settings: Any) -> NDArray[np.float64]:
    """theta (3,) rad of the present estimator."""
    found = calibrate_strips(strips, R_cs0, settings)
    if not isinstance(found, InstallationEstimate):
        raise SystemExit(f"the targets that both matched do not determine the matrix: {found}")
    return np.asarray(found.theta)


if __name__ == "__main__":
    main()
