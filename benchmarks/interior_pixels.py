"""The interior of a camera that is 1e-4 off in focal length, 3 px in its CCDs' places, 0.1 mrad in their
rotation and 2 px in a smooth distortion, from raw pixels of six strips of the sky; a px is 1 µrad.

    python benchmarks/interior_pixels.py --cameras mini --seeds 1-5
    python benchmarks/interior_pixels.py --cameras paper --per-deg2 40 --seeds 1-2

The dump states the wrong camera, and by how much it may be wrong. With `--per-deg2` the sky of the strips is
drawn at random, that many stars from V 6 to 9 a square degree, and the dump has their catalogue
(`files.star_catalogue`): 40 give a strip of 1.4 x 1.5 degrees as many stars as the real sky gives a scan of
25 degrees (`docs/plan.md`). Without it the sky is that of Hipparcos. `benchmarks/interior_orientation.py` has
the same at the level of vectors.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from record import exit_status, head, verdict
from sky_strips import scenario_of, seeds

from boresight.calib.interior_parameters import InteriorModel, InteriorPriors
from boresight.features.interior.interior_estimate import map_difference_px
from boresight.features.interior.interior_of_dumps import calibrate_remote_camera
from boresight.geometry.earth_orientation import bundled_earth_orientation
from boresight.geometry.geoid import egm96
from boresight.geometry.line_camera import LineCamera
from boresight.pipeline.files.dump_writer import write_dump
from boresight.pipeline.files.scenario_file import fly
from boresight.pipeline.files.star_tables import read_star_table
from boresight.pipeline.run.executor import InOrder
from boresight.pipeline.run.settings import Settings
from boresight.simulator.cameras import calibrated_line_camera
from boresight.simulator.mission import render_mission
from boresight.simulator.mission_records import Mission
from boresight.simulator.scenario import Scenario
from boresight.star_id.catalogue import hipparcos_stars

SCANS = 6
STATED_RAD = 4e-6  # look_distortion_px of the dump: what the assumed camera may be wrong by
PX_RAD = 1e-6  # a pixel of the paper's camera, in which all is stated
OF_CCD = {"focal": 1e-4, "rotation": 1e-4}
SHIFT_RAD, CURVE_RAD = 3e-6, 2e-6
DRAWN_V, FAINTER = (6.0, 9.0), 3.0  # of the drawn sky: stars of one magnitude over those of the one before
CATALOGUE = "stars.csv"
WAVES = 2.0 * np.pi * np.array([1.3, 2.7])  # of the distortion, over the field


def wrong_camera(true: LineCamera, priors: InteriorPriors, rng: np.random.Generator) -> LineCamera:
    """The camera as it is assumed: the true one changed by these sizes, with random signs."""
    model = InteriorModel.of(true, priors)
    shift = SHIFT_RAD / true.pixel_rad
    sizes = OF_CCD | {"shift_along": shift, "shift_across": shift}
    values = np.array([sizes.get(name.split("/")[0], 0.0) for name in model.names])
    values *= rng.choice([-1.0, 1.0], len(values))
    for axis in ("along", "across"):
        phase = rng.uniform(0.0, 2.0 * np.pi, 2)
        for c, knots in enumerate(model.knots):
            places = (c + knots[:, None] / (true.n_px(c) - 1.0)) / true.n_ccds
            for k, value in enumerate(np.cos(WAVES * places + phase).sum(axis=1)):
                values[model.names.index(f"curve_{axis}/{c}/{k}")] = CURVE_RAD / true.pixel_rad * value
    return model.corrected(values)


def drawn_catalogue(scenario: Scenario, per_deg2: float, rng: np.random.Generator) -> pd.DataFrame:
    """Stars around the scans, columns as in the Gaia archive, errors of 5 mas."""
    tables = []
    for scan in scenario.sky_strips.scans:
        side = 3.0  # degrees; a strip shows half of it
        n = rng.poisson(per_deg2 * side**2)
        dec = scan.dec_deg + side * rng.uniform(-0.5, 0.5, n)
        ra = scan.ra_deg + side * rng.uniform(-0.5, 0.5, n) / np.cos(np.radians(dec))
        v = np.log(rng.uniform(*(FAINTER**end for end in DRAWN_V), n)) / np.log(FAINTER)
        tables.append(pd.DataFrame({"ra": ra % 360.0, "dec": dec, "phot_g_mean_mag": v}))
    table = pd.concat(tables, ignore_index=True)
    rest = dict.fromkeys(("pmra", "pmdec", "pmra_error", "pmdec_error"), 0.0)
    return table.assign(
        source_id=np.arange(1, len(table) + 1), ref_epoch=2024.0, ra_error=5.0, dec_error=5.0, **rest
    )


def flown(scenario: Scenario, seed: int, per_deg2: float, catalogue: Path) -> Mission:
    """The mission under the sky of Hipparcos, or under a drawn one that is written to `catalogue`."""
    if not per_deg2:
        return fly(scenario, seed)
    drawn_catalogue(scenario, per_deg2, np.random.default_rng([23, seed])).to_csv(catalogue, index=False)
    survey = read_star_table(catalogue, CATALOGUE)
    earth = bundled_earth_orientation()
    return render_mission(scenario, hipparcos_stars().places, earth, egm96(), seed, survey=survey)


def run(cameras: str, seed: int, per_deg2: float, folder: Path) -> tuple[float, ...]:
    """Map error before and after, its stated 1-sigma (px rms), chi2 of the map, stars."""
    scenario = scenario_of(cameras, SCANS, 0, seed)
    none = replace(scenario.errors, distortion_px=0.0)
    pixel_rad = calibrated_line_camera(scenario.line_camera).pixel_rad
    priors = InteriorPriors(
        shift_px=5e-6 / pixel_rad, curve_px=3e-6 / pixel_rad, curve_length_px=5e-3 / pixel_rad
    )  # the default ones of a camera of 1 µrad
    try:
        catalogue = folder.with_name(CATALOGUE)
        mission = flown(replace(scenario, errors=none), seed, per_deg2, catalogue)
        true = mission.truth.line_camera
        assumed = wrong_camera(true, priors, np.random.default_rng([19, seed]))
        stated = replace(mission.errors, look_distortion_px=STATED_RAD / true.pixel_rad)
        write_dump(
            replace(mission, line_camera=assumed, errors=stated), folder, created_by=Path(__file__).name
        )
        if per_deg2:
            shutil.move(catalogue, folder / CATALOGUE)
            text = (folder / "dump.toml").read_text()
            named = text.replace("[files]\n", f'[files]\nstar_catalogue = "{CATALOGUE}"\n')
            (folder / "dump.toml").write_text(named)
        found = calibrate_remote_camera(
            [folder], Settings(), priors, InOrder(), lambda stage, done, total: None
        ).found
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    before, _ = map_difference_px(assumed, true, 60)
    error, rows = map_difference_px(found.camera, true, 60)
    sigma = found.map_sigma_px(rows[:, 0].astype(np.int64), rows[:, 1])
    in_px = true.pixel_rad / PX_RAD
    sizes = [in_px * float(np.sqrt(np.mean(one**2))) for one in (before, error, sigma)]
    return (*sizes, float(np.mean((error / sigma) ** 2)), float(found.installation.n_targets))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=seeds, default=seeds("1-5"))
    parser.add_argument("--cameras", choices=("mini", "paper"), default="mini")
    parser.add_argument("--per-deg2", type=float, default=0.0, help="stars of a drawn sky; 0: Hipparcos")
    parser.add_argument("--scratch", type=Path)
    options = parser.parse_args()
    head("interior orientation from raw pixels")
    print(f"{options.cameras} cameras: {SCANS} strips of the sky; map error, px rms of both axes")
    print("seed   before   after  stated   chi2  stars", flush=True)
    table = []
    with tempfile.TemporaryDirectory(dir=options.scratch) as scratch:
        for seed in options.seeds:
            one = run(options.cameras, seed, options.per_deg2, Path(scratch) / "dump")
            table.append(one)
            print(
                f"{seed:4d} {one[0]:8.2f} {one[1]:7.3f} {one[2]:7.3f} {one[3]:6.2f} {one[4]:6.0f}", flush=True
            )
    before, after, stated = np.sqrt(np.mean(np.square([one[:3] for one in table]), axis=0))
    chi2 = float(np.mean([one[3] for one in table]))
    print(f"\nrms {before:.2f} px before, {after:.3f} after, {stated:.3f} stated")
    verdict(f"map error {after:.3f} px rms (0.1)", after <= 0.1)
    verdict(f"chi2 {chi2:.2f} (0.8 to 1.2)", 0.8 <= chi2 <= 1.2)


if __name__ == "__main__":
    main()
    raise SystemExit(exit_status())
