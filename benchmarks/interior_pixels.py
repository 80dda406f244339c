"""The interior of a camera that is 1e-4 off in focal length, 3 px in its CCDs' places, 0.1 mrad in their
rotation and 2 px in a smooth distortion, from raw pixels of six strips of the sky; a px is 1 µrad.

    python benchmarks/interior_pixels.py --cameras mini --seeds 1-5

The dump states the wrong camera, and by how much it may be wrong. `benchmarks/interior_orientation.py` has
the same at the level of vectors.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from record import exit_status, head, verdict
from sky_strips import scenario_of, seeds

from boresight.calib.interior.estimate import map_difference_px
from boresight.calib.interior.parameters import InteriorModel, InteriorPriors
from boresight.geometry.line_camera import LineCamera
from boresight.pipeline.files.dump_writer import write_dump
from boresight.pipeline.files.scenario_file import fly
from boresight.pipeline.results.interior import calibrate_remote_camera
from boresight.pipeline.settings import Settings
from boresight.pipeline.work.executor import InOrder
from boresight.simulator.cameras import calibrated_line_camera

SCANS = 6
STATED_RAD = 4e-6  # look_distortion_px of the dump: what the assumed camera may be wrong by
PX_RAD = 1e-6  # a pixel of the paper's camera, in which all is stated
OF_CCD = {"focal": 1e-4, "rotation": 1e-4}
SHIFT_RAD, CURVE_RAD = 3e-6, 2e-6
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


def run(cameras: str, seed: int, folder: Path) -> tuple[float, ...]:
    """Map error before and after, its stated 1-sigma (px rms), chi2 of the map, stars."""
    scenario = scenario_of(cameras, SCANS, 0, seed)
    none = replace(scenario.errors, distortion_px=0.0, distortion_across_px=0.0)
    pixel_rad = calibrated_line_camera(scenario.line_camera).pixel_rad
    priors = InteriorPriors(
        shift_px=5e-6 / pixel_rad, curve_px=3e-6 / pixel_rad, curve_length_px=5e-3 / pixel_rad
    )  # the default ones of a camera of 1 µrad
    try:
        mission = fly(replace(scenario, errors=none), seed)
        true = mission.truth.line_camera
        assumed = wrong_camera(true, priors, np.random.default_rng([19, seed]))
        stated = replace(mission.errors, look_distortion_px=STATED_RAD / true.pixel_rad)
        write_dump(
            replace(mission, line_camera=assumed, errors=stated), folder, created_by=Path(__file__).name
        )
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
    parser.add_argument("--scratch", type=Path)
    options = parser.parse_args()
    head("interior orientation from raw pixels")
    print(f"{options.cameras} cameras: {SCANS} strips of the sky; map error, px rms of both axes")
    print("seed   before   after  stated   chi2  stars", flush=True)
    table = []
    with tempfile.TemporaryDirectory(dir=options.scratch) as scratch:
        for seed in options.seeds:
            one = run(options.cameras, seed, Path(scratch) / "dump")
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
