"""Write a simulated mission as a dump (docs/dump-format.md); its truth goes to `truth/` only."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rasterio.transform import Affine
from rasterio.windows import Window

from boresight.pipeline.files.dump_schema import FILES, head_of_dump
from boresight.pipeline.files.images.png import png_of_noise
from boresight.pipeline.files.images.tiff import TILES, tiff_opened, write_tiff
from boresight.pipeline.files.orbit_file import orbit_message
from boresight.pipeline.files.remote_camera import remote_camera_table
from boresight.pipeline.files.star_side import star_camera_table
from boresight.pipeline.files.text_tables import write_csv, write_toml
from boresight.pipeline.files.whole_file import is_vacant
from boresight.simulator import mission_records
from boresight.simulator.scenario import scenario_to_dict

__all__ = ["Each", "Rendered", "write_dump"]

# Degree of the Lagrange interpolation that a written orbit states.
INTERPOLATION_DEGREE = 7
SIMULATED_ID = "2024-000A"  # international designator that no satellite has
# Smaller strips are compressed as far as every reader of TIFF allows: they may become fixtures. Larger ones
# take a sixth of the time so.
SMALL_PIXELS = 4_000_000
SMALL_STRIP = {"compress": "deflate", "zlevel": 6, "predictor": 2}
LARGE_STRIP = {"compress": "zstd", "zstd_level": 1, "predictor": 2}

Rendered = mission_records.RenderedStrip | mission_records.RenderedExposure
Each = Callable[[Callable[[Rendered], None], Sequence[Rendered]], Iterable[None]]


def write_dump(mission: mission_records.Mission, root: Path, *, created_by: str, each: Each = map) -> None:
    """Write the dump to `root`. `FileExistsError` if not empty.

    `each` applies a function to the images, one after another or in forked processes: a mission cannot be
    pickled. Every image has random numbers of its own, so that the bytes do not depend on it.
    """
    if not is_vacant(root):
        raise FileExistsError(f"{root} exists and is not an empty folder")
    ground = ("chips", "terrain") if mission.terrain is not None else ()
    for folder in ("exposures", "strips", *ground, "truth"):
        (root / folder).mkdir(parents=True, exist_ok=True)
    write_toml(root / "star_camera.toml", star_camera_table(mission.star_camera, mission.scenario.sky.bits))
    remote = remote_camera_table(mission.line_camera, mission.scenario.ground.bits)
    write_toml(root / "remote_camera.toml", remote)
    installation = {
        "quaternion_cs": mission.installation.R_cs.as_quat().tolist(),
        "sigma_rad": np.asarray(mission.installation.sigma_rad, dtype=float).tolist(),
    }
    write_toml(root / "installation.toml", installation)
    (root / "orbit.oem").write_text(_oem(mission, mission.orbit), encoding="utf-8")
    images: list[Rendered] = [*mission.strips, *mission.exposures]  # the longest work first
    for _ in each(partial(_write_image, root), images):
        pass
    _write_exposures(root, mission)
    _write_strips(root, mission)
    if mission.terrain is not None:
        _write_targets(root, mission)
        _write_terrain(root / "terrain" / "dem.tif", mission.terrain)
    _write_truth(root / "truth", mission, mission.truth)
    write_toml(root / "dump.toml", _head(mission, created_by))  # last: a dump with a dump.toml is complete


OF_ERRORS = ("position_m", "clock_s", "vibration_arcsec", "look_distortion_px")  # as records have them, too


def _head(mission: mission_records.Mission, created_by: str) -> dict[str, Any]:
    errors, terrain = mission.errors, mission.terrain
    of_ground = {"targets": "targets.csv", "terrain": "terrain/dem.tif"} if terrain is not None else {}
    of_ccds = dict(zip(("look_ccd_shift_px", "look_ccd_slope_px", "look_ccd_bend_px"), errors.look_ccd_px))
    heights = {"height_kind": "egm96", "sigma_m": terrain.sigma_m} if terrain is not None else {}
    return {
        **head_of_dump(mission.scenario.name, created_by),
        "files": FILES | of_ground,
        "errors": {
            **{name: getattr(errors, name) for name in OF_ERRORS},
            "look_distortion_length_px": mission.scenario.errors.distortion_length_px,
            **of_ccds,
        },
        **({"terrain": heights} if heights else {}),
    }


def _oem(mission: mission_records.Mission, orbit: mission_records.OrbitReport) -> str:
    return orbit_message(
        mission.scenario.name,
        "ITRF",
        ("lagrange", INTERPOLATION_DEGREE),
        mission.epoch.utc_from_seconds(orbit.t_s),
        orbit.positions_m,
        orbit.velocities_m_s,
        SIMULATED_ID,
    )


def _write_image(root: Path, image: Rendered) -> None:
    if isinstance(image, mission_records.RenderedStrip):
        _write_strip_image(root / _file_of_strip(image), image)
    else:
        (root / f"exposures/{image.exposure_id}.png").write_bytes(png_of_noise(image.image()))


def _file_of_strip(strip: mission_records.RenderedStrip) -> str:
    return f"strips/{strip.strip_id}_ccd{strip.ccd}.tif"


def _write_exposures(root: Path, mission: mission_records.Mission) -> None:
    utc = mission.epoch.utc_from_seconds([exposure.t_s for exposure in mission.exposures])
    rows = []
    for exposure, instant in zip(mission.exposures, utc):
        file = f"exposures/{exposure.exposure_id}.png"
        rows.append([exposure.exposure_id, file, instant, exposure.exposure_s])
    write_csv(root / "exposures.csv", ["id", "file", "utc_mid", "exposure_s"], rows)


def _write_strips(root: Path, mission: mission_records.Mission) -> None:
    utc = mission.epoch.utc_from_seconds([strip.t_first_row_s for strip in mission.strips])
    rows, with_kind = [], any(strip.kind != "ground" for strip in mission.strips)
    for strip, instant in zip(mission.strips, utc):
        file = _file_of_strip(strip)
        kind = [strip.kind] if with_kind else []
        rows.append([strip.strip_id, strip.ccd, file, instant, repr(strip.row_period_s), strip.lines, *kind])
    columns = ["id", "ccd", "file", "utc_first_row", "row_period_s", "lines"]
    write_csv(root / "strips.csv", [*columns, "kind"] if with_kind else columns, rows)


def _write_strip_image(path: Path, strip: mission_records.RenderedStrip) -> None:
    kind = "uint8" if strip.bits <= 8 else "uint16"
    how = SMALL_STRIP if strip.lines * strip.samples < SMALL_PIXELS else LARGE_STRIP
    with tiff_opened(path, (strip.lines, strip.samples), kind, **TILES, bigtiff="if_safer", **how) as image:
        line = 0
        for block in strip.blocks(512):
            image.write(block, 1, window=Window(0, line, strip.samples, len(block)))
            line += len(block)


def _write_targets(root: Path, mission: mission_records.Mission) -> None:
    chips = {chip.target_id: chip for chip in mission.chips}
    rows = []
    for target in mission.targets:
        file = f"chips/{target.target_id}.tif"
        _write_chip(root / file, chips[target.target_id])
        position = [f"{target.lat_deg:.10f}", f"{target.lon_deg:.10f}", f"{target.height_m:.4f}"]
        rows.append([target.target_id, *position, target.height_kind, *target.sigma_m, file])
    columns = ["id", "lat_deg", "lon_deg", "height_m", "height_kind"]
    columns += ["sigma_east_m", "sigma_north_m", "sigma_up_m", "chip"]
    write_csv(root / "targets.csv", columns, rows)


def _write_chip(path: Path, chip: mission_records.ChipImage) -> None:
    place = {"crs": f"EPSG:{chip.epsg}", "transform": Affine(*chip.affine)}
    write_tiff(path, chip.image, **place, zlevel=9, predictor=2)


def _write_terrain(path: Path, terrain: mission_records.TerrainReport) -> None:
    centimetres = np.round(np.asarray(terrain.heights_m, dtype=float), 2).astype(np.float32)
    place = {"crs": "EPSG:4326", "transform": Affine(*terrain.affine), "nodata": -32768.0}
    write_tiff(path, centimetres, **place, zlevel=9, predictor=3)


def _write_truth(root: Path, mission: mission_records.Mission, truth: mission_records.Truth) -> None:
    installation = {
        "quaternion_cs": truth.R_cs.as_quat().tolist(),
        "theta_rad": np.asarray(truth.theta_rad).tolist(),
    }
    write_toml(root / "installation.toml", installation)
    write_toml(root / "scenario.toml", {"seed": truth.seed, "scenario": scenario_to_dict(mission.scenario)})
    for name, points in (("check_points", truth.check_points), ("targets", truth.targets)):
        rows = []
        for p in points:
            place = f"{p.lat_deg:.11f}", f"{p.lon_deg:.11f}", f"{p.height_ellipsoidal_m:.5f}"
            rows.append([p.point_id, p.strip_id, p.ccd, f"{p.sample:.6f}", f"{p.line:.6f}", *place])
        columns = "id strip ccd sample line lat_deg lon_deg height_m".split()
        write_csv(root / f"{name}.csv", columns, rows)
    if truth.sky_stars:
        stars = []
        for s in truth.sky_stars:
            numbers = f"{s.sample:.6f}", f"{s.line:.6f}", f"{s.charge_e:.1f}", f"{s.v_mag:.2f}"
            stars.append([s.strip_id, s.ccd, s.hip, *numbers])
        write_csv(root / "sky_stars.csv", "strip ccd hip sample line charge_e v_mag".split(), stars)
    strips = [[s.strip_id, repr(s.clock_offset_s), *s.position_error_m.tolist()] for s in truth.strips]
    columns = ["strip", "clock_offset_s", "error_x_m", "error_y_m", "error_z_m"]
    write_csv(root / "strips.csv", columns, strips)
