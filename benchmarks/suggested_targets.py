"""Targets that `boresight targets suggest` chooses in real ortho-images, taken into simulated missions.

    python benchmarks/suggested_targets.py ORTHO OTHER_DATE FOLDER [--seeds 5] [--targets 12]

The ground of each mission is ORTHO (one band), laid out endlessly by mirroring. Its user has ortho-images of
two dates around each strip (mirrored as the ground is), the mission's height model and a dump with the
simulator's targets. `suggest` chooses targets for the dump, the dump gets them in place of its own, and is
calibrated; then the same with as many of the suitable places drawn at random. Printed: NEES and
the stated sigma of Z of both.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import NDArray
from pyproj import Transformer

sys.path.insert(0, str(Path(__file__).parent))
from record import band_of_mean_nees, exit_status, head, verdict

from boresight.features.targets.ortho_files import read_heights, read_ortho
from boresight.features.targets.suggestions import SuggestRequest, suggest_in, write_targets
from boresight.geometry.constants import ARCSEC
from boresight.geometry.installation import theta_between
from boresight.pipeline.calibration.calibrate import calibrate_dump
from boresight.pipeline.errors import DataNotSufficientError
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.files.dump_writer import write_dump
from boresight.pipeline.files.scenario_file import fly, named_scenario
from boresight.pipeline.results.validate import true_installation
from boresight.pipeline.run.settings import Settings

CHIP_PX = 128
SIGMA_M = 0.5
BAND = 1


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("ortho", type=Path)
    parser.add_argument("other", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--targets", type=int, default=12)
    given = parser.parse_args()
    head("Targets suggested in real ortho-images, calibrated in simulated missions over them")
    print("seed  targets  NEES    sigma Z chosen  random  ratio   forecast Z   error/sigma X Y Z")
    nees, ratios = [], []
    for seed in range(1, given.seeds + 1):
        squared, ratio = mission(given, seed)
        nees.append(squared)
        ratios.append(ratio)
    low, high = band_of_mean_nees(len(nees))
    found = float(np.mean(nees))
    verdict(f"mean NEES {found:.2f} within {low:.2f} and {high:.2f}", low < found < high)
    ratio = float(np.median(ratios))
    verdict(f"sigma of Z, chosen over random, median {ratio:.3f}, at most 0.8", ratio <= 0.8)


def mission(given: argparse.Namespace, seed: int) -> tuple[float, float]:
    """NEES with the chosen targets, and the ratio of the sigmas of Z, chosen over random."""
    root = given.folder / f"seed{seed}"
    shutil.rmtree(root, ignore_errors=True)
    root.mkdir(parents=True)
    with rasterio.open(given.ortho) as image:
        middle = image.xy(image.height // 2, image.width // 2)
        lon, lat = Transformer.from_crs(image.crs, 4326, always_xy=True).transform(*middle)
        one_band(image, root / "ground.tif")
    place = [f"orbit.latitude_deg={lat}", f"orbit.longitude_deg={lon}"]
    changes = [f"ground.image={root / 'ground.tif'}", *place]
    dump = root / "dump"
    write_dump(fly(named_scenario("mini", changes), seed), dump, created_by="benchmarks/suggested_targets.py")
    opened = open_dump(dump)
    orthos = [read_ortho(path) for path in around(opened, given.ortho, given.other, root)]
    heights = read_heights([dump / "terrain" / "dem.tif"], "egm96")
    wanted = SuggestRequest(size_px=CHIP_PX, most=given.targets, sigma_m=SIGMA_M, sigma_up_m=1.0)
    chosen = suggest_in(orthos, heights, wanted, opened)
    rows = np.random.default_rng(seed).permutation(len(chosen.suitable))[: len(chosen.targets)]
    squared, sigma, error = calibrated(dump, chosen.targets)
    _, at_random, _ = calibrated(dump, [chosen.suitable[n] for n in rows])
    assert chosen.choice is not None
    shown = " ".join(f"{value:+.2f}" for value in error / sigma)
    print(
        f"{seed:4d}  {len(chosen.targets):4d}/{len(chosen.suitable):4d}  {squared:6.2f}"
        f"  {sigma[2] / ARCSEC:10.4f}  {at_random[2] / ARCSEC:8.4f}  {sigma[2] / at_random[2]:6.3f}"
        f"  {chosen.choice.sigma_rad[-1, 2] / ARCSEC:8.4f}   {shown}",
        flush=True,
    )
    return squared, float(sigma[2] / at_random[2])


def one_band(image: rasterio.DatasetReader, path: Path) -> None:
    """The first band as a file: the ground."""
    profile = {"driver": "GTiff", "width": image.width, "height": image.height, "count": 1, "dtype": "uint8"}
    with rasterio.open(path, "w", **profile, crs=image.crs, transform=image.transform) as file:
        file.write(image.read(BAND), 1)


def around(dump, ortho: Path, other: Path, root: Path) -> list[Path]:
    """Two by two mirrored copies of both dates around the targets of each strip, as multi-band GeoTIFFs."""
    strips = {strip.strip_id: [] for strip in dump.strips}
    for target in dump.targets:
        strips[target.target_id.split("-")[0]].append(target.p_e)
    paths = []
    for strip_id, points in strips.items():
        for date, source in (("new", ortho), ("old", other)):
            with rasterio.open(source) as image:
                values, t, crs = image.read(), image.transform, image.crs
            to_map = Transformer.from_crs(4978, crs, always_xy=True)
            x, y, _ = np.mean([to_map.transform(*p_e) for p_e in points], axis=0)
            rows, columns = values.shape[1:]
            column, row = ~t * (x, y)
            for i in (round(column / (columns - 1)) - 1, round(column / (columns - 1))):
                for j in (round(row / (rows - 1)) - 1, round(row / (rows - 1))):
                    place = t * rasterio.Affine.translation(i * (columns - 1), j * (rows - 1))
                    path = root / f"{strip_id}_{date}_{i}_{j}.tif"
                    write(path, values[:, :: 1 - 2 * (j % 2), :: 1 - 2 * (i % 2)], crs, place)
                    paths.append(path)
    return sorted(paths, key=lambda path: "_old_" in path.name)


def write(path: Path, values: NDArray[np.uint8], crs: object, transform: rasterio.Affine) -> None:
    size = {"width": values.shape[2], "height": values.shape[1], "count": 1}
    profile = {"driver": "COG", "dtype": "uint8", **size}
    with rasterio.open(path, "w", **profile, crs=crs, transform=transform) as file:
        file.write(values[BAND - 1], 1)


def calibrated(dump: Path, targets) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    """NEES, stated sigma and error (3,) of a dump with these targets in place of its own."""
    for name in ("chips", "targets.csv"):
        path = dump / name
        shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
    write_targets(targets, dump, CHIP_PX)
    opened = open_dump(dump)
    try:
        found = calibrate_dump(opened, Settings()).estimate
    except DataNotSufficientError as error:
        sys.exit(f"{dump}: {error}")
    error = theta_between(found.R_cs, true_installation(opened))
    return float(error @ np.linalg.solve(found.cov_theta, error)), found.sigma_theta, error


if __name__ == "__main__":
    main()
    sys.exit(exit_status())
