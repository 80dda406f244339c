"""Ground calibration targets: where they are, their chips from a reference ortho-image, and the survey's
errors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pyproj import Transformer

from geometry.constants import WGS84
from geometry.geodesy import ecef_from_geodetic, geodetic_from_ecef
from geometry.geoid import Geoid
from simulator.ground import BlurredGround
from simulator.records import ChipImage, GroundTarget, TruePoint
from simulator.scan import Scene, read_ground
from simulator.scenario import TargetSettings

__all__ = ["Placed", "check_points", "place_targets"]

Array = NDArray[np.float64]

_TRIES = 40  # places looked at for a target before a bland one is taken


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """One target: what the user gets, and where it truly is."""

    target: GroundTarget
    chip: ChipImage
    truth: tuple[TruePoint, ...]


def place_targets(
    strip_id: str,
    scene: Scene,
    lines: int,
    reference: BlurredGround,
    pixel_m: float,
    settings: TargetSettings,
    geoid: Geoid,
    rng: np.random.Generator,
) -> list[Placed]:
    """Targets of one strip, spread over its rows and CCDs.

    `reference` is the ground as the chips show it, `pixel_m` the strip's pixel on the ground. A place
    whose chip has little texture is given up for another one.
    """
    chip_m = pixel_m * settings.chip_pixel
    placed = []
    for n in range(settings.per_strip):
        for _ in range(_TRIES):
            ccd, sample, line = _somewhere(n, scene, lines, settings, rng)
            point_e = scene.model.ground_points(ccd, np.array([sample]), np.array([line]), scene.surface)
            east, north = _on_chip_lattice(point_e, scene.epsg, chip_m)
            image = _chip(east, north, reference, chip_m, settings, rng)
            if image.std() >= np.hypot(settings.least_texture_dn, settings.chip_noise_dn):
                break
        name = f"{strip_id}-t{n + 1:02d}"
        target, chip, true_e = _surveyed(name, scene, east, north, image, chip_m, settings, geoid, rng)
        placed.append(Placed(target, chip, tuple(_true_points(name, strip_id, scene, lines, true_e))))
    return placed


def check_points(
    strip_id: str, scene: Scene, lines: int, count: int, rng: np.random.Generator
) -> list[TruePoint]:
    """Points of the ground that a strip sees, spread over its rows and CCDs; known to the truth alone."""
    points: list[TruePoint] = []
    for n in range(count):
        ccd = n % scene.model.camera.n_ccds
        sample = rng.uniform(0.0, scene.model.camera.n_px(ccd) - 1.0)
        line = (n + rng.uniform()) * (lines - 1.0) / count
        p_e = scene.model.ground_points(ccd, np.array([sample]), np.array([line]), scene.surface)
        points += _true_points(f"{strip_id}-c{n + 1:02d}", strip_id, scene, lines, p_e)
    return points


def _somewhere(
    n: int, scene: Scene, lines: int, settings: TargetSettings, rng: np.random.Generator
) -> tuple[int, float, float]:
    """CCD, sample and line of a possible place of target n, its chip well inside the image."""
    camera = scene.model.camera
    ccd = n % camera.n_ccds
    margin = 0.75 * settings.chip_size_px
    line = margin + (n + rng.uniform()) / settings.per_strip * (lines - 1.0 - 2.0 * margin)
    return ccd, float(rng.uniform(margin, camera.n_px(ccd) - 1.0 - margin)), float(line)


def _on_chip_lattice(point_e: Array, epsg: int, pixel_m: float) -> tuple[float, float]:
    """The corner of the chip's pixels that is nearest to a ground point: easting and northing."""
    east, north, _ = Transformer.from_crs(4978, epsg, always_xy=True).transform(*point_e[0])
    return round(east / pixel_m) * pixel_m, round(north / pixel_m) * pixel_m


def _chip(
    east: float,
    north: float,
    reference: BlurredGround,
    chip_m: float,
    settings: TargetSettings,
    rng: np.random.Generator,
) -> NDArray[np.uint8]:
    """The reference image around a point, north-up, the point being the corner in its middle."""
    half = round(settings.chip_size_px / settings.chip_pixel / 2.0)
    offset_m = (np.arange(-half, half) + 0.5) * chip_m
    texel_m = reference.texel_m
    column, row = np.meshgrid((east + offset_m) / texel_m - 0.5, -(north - offset_m) / texel_m - 0.5)
    image = 8.0 + 230.0 * read_ground(reference, column, row, rng)
    image += settings.chip_noise_dn * rng.standard_normal(image.shape)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def _surveyed(
    target_id: str,
    scene: Scene,
    east: float,
    north: float,
    image: NDArray[np.uint8],
    chip_m: float,
    settings: TargetSettings,
    geoid: Geoid,
    rng: np.random.Generator,
) -> tuple[GroundTarget, ChipImage, Array]:
    """A target with the errors of its survey, which its chip's map coordinates share; and its true place."""
    to_map = Transformer.from_crs(4326, scene.epsg, always_xy=True)
    lon_deg, lat_deg = to_map.transform(east, north, direction="INVERSE")
    lat, lon = np.radians([lat_deg]), np.radians([lon_deg])
    height = scene.surface.height_m(lat, lon)
    p_e = ecef_from_geodetic(lat, lon, height, WGS84)
    error = rng.standard_normal(3) * settings.sigma_m
    told_east, told_north = east + error[0], north + error[1]
    told_lon, told_lat = to_map.transform(told_east, told_north, direction="INVERSE")
    told_height = height[0] + error[2] - geoid.undulation_m(lat, lon)[0]
    half = len(image) / 2 * chip_m
    affine = (chip_m, 0.0, told_east - half, 0.0, -chip_m, told_north + half)
    told = (float(told_lat), float(told_lon), float(told_height))
    target = GroundTarget(target_id, *told, "egm96", settings.sigma_m)
    return target, ChipImage(target_id, image, affine, scene.epsg), p_e


def _true_points(point_id: str, strip_id: str, scene: Scene, lines: int, p_e: Array) -> list[TruePoint]:
    """A ground point (1, 3) in every CCD that sees it."""
    lat, lon, height = geodetic_from_ecef(p_e, WGS84)
    points = []
    for ccd in range(scene.model.camera.n_ccds):
        (sample,), (line,) = scene.model.pixels_from_ground(ccd, p_e)
        if -0.5 <= sample <= scene.model.camera.n_px(ccd) - 0.5 and -0.5 <= line <= lines - 0.5:
            points.append(
                TruePoint(
                    point_id=point_id,
                    strip_id=strip_id,
                    ccd=ccd,
                    sample=float(sample),
                    line=float(line),
                    t_s=float(scene.model.instants(np.array([line]))[0]),
                    p_e=(float(p_e[0, 0]), float(p_e[0, 1]), float(p_e[0, 2])),
                    lat_deg=float(np.degrees(lat[0])),
                    lon_deg=float(np.degrees(lon[0])),
                    height_ellipsoidal_m=float(height[0]),
                )
            )
    return points
